"""Plots and page of a recording."""

PUBLIC = ("decimation", "run_page")
"""Modules that other rooms import; the others are private."""
