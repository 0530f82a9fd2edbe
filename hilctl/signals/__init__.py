"""Metrics of signals."""

PUBLIC = ("cycle_metrics", "segment_metrics")
"""Modules that other packages import; the others are private."""
