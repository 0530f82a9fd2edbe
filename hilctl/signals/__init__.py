"""Metrics of signals."""

PUBLIC = ("cycle_metrics", "segment_metrics")
"""Modules that other rooms import; the others are private."""
