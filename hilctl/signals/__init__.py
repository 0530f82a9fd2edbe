"""Metrics of periodic signals.

cycle_metrics.py  mean cycle, peak hysteresis, loop area, errors, sensor noise
"""
