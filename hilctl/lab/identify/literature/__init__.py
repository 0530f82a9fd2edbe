"""Fits of models of the literature, one module per kind."""
