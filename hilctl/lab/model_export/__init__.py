"""Models as functions in C and MATLAB."""

PUBLIC = ("model_export",)
"""Modules that other packages import; the others are private."""
