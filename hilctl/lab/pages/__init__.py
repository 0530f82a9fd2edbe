"""Parts of plots and self-contained HTML pages."""

PUBLIC = ("figure_layout", "html", "plot_style")
"""Modules that other packages import; the others are private."""
