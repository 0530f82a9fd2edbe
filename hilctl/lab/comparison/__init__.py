"""Comparison of hysteresis models on the same loops."""

PUBLIC = ("compare", "comparison_page")
"""Modules that other rooms import; the others are private."""
