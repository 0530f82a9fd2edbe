"""Fits whose thresholds are searched from several starts."""
