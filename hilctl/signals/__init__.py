"""Metrics of periodic signals.

cycle_metrics.py    mean cycle, peak hysteresis, loop area, errors, sensor noise
segment_metrics.py  metrics of a segment in one pass, for report, recorder and live views
"""

PUBLIC = ("cycle_metrics", "segment_metrics")
"""Modules that other rooms import; the others are private."""
