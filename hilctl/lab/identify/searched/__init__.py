"""Fits of play models whose thresholds are searched."""
