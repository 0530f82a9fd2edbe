"""Metrics of signals."""

PUBLIC = ("cycle_metrics", "segment_metrics", "spectrum")
"""Modules that other rooms import; the others are private."""
