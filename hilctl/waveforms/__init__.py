"""Reference waveforms.

spec.py           waveforms in the experiment file
shapes.py         samples of one waveform
waveform_file.py  waveforms from CSV, NPY and MCAP files
build.py          a complete reference: soft starts and ends, sequences, segments
"""

PUBLIC = ("build", "shapes", "spec")
"""Modules that other rooms import; the others are private."""
