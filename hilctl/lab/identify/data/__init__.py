"""Loops and histories from recordings and tables."""
