"""Fits of other models of the literature."""
