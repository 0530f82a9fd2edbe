"""Fit of the effective-field model to whole histories."""
