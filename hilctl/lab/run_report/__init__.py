"""Plots and page of a recording."""

PUBLIC = ("contour_page", "decimation", "run_page")
"""Modules that other packages import; the others are private."""
