"""Kinds of model of the literature, for comparison."""
