"""Metrics of periodic signals.

cycle_metrics.py  mean cycle, peak hysteresis, loop area, errors, sensor noise
"""

PUBLIC = ("cycle_metrics",)
"""Modules that other rooms import; the others are private."""
