"""Reference waveforms."""

PUBLIC = ("build", "shapes", "spec")
"""Modules that other packages import; the others are private."""
