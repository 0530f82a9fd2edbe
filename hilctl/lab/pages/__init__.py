"""Parts of plots and self-contained HTML pages."""

PUBLIC = ("figure_layout", "html", "plot_style")
"""Modules that other rooms import; the others are private."""
