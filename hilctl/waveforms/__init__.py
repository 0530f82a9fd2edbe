"""Reference waveforms.

spec.py           waveforms in the experiment file
shapes.py         samples of one waveform
build.py          a complete reference: files, soft starts and ends, sequences, segments
"""

PUBLIC = ("build", "shapes", "spec")
"""Modules that other rooms import; the others are private."""
