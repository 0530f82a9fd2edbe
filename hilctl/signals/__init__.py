"""Metrics of signals.

cycle_metrics.py    mean cycle, peak hysteresis, loop area, errors, sensor noise
segment_metrics.py  metrics of a segment in one pass, for report, recorder and live views
spectrum.py         harmonics, spectra, Allan deviation
"""

PUBLIC = ("cycle_metrics", "segment_metrics", "spectrum")
"""Modules that other rooms import; the others are private."""
