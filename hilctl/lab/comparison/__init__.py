"""Comparison of hysteresis models on the same loops."""

PUBLIC = ("compare", "comparison_page")
"""Modules that other packages import; the others are private."""
