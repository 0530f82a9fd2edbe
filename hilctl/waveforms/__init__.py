"""Reference waveforms."""

PUBLIC = ("build", "shapes", "spec")
"""Modules that other rooms import; the others are private."""
