"""Reference waveforms: what the experiment file may ask for, and the samples that come of it.

spec.py     pydantic models of each kind
shapes.py   pure: one kind and a sample rate -> label, spectrum, samples
table.py    waveforms read from CSV, NPY and MCAP files
build.py    a whole reference: shapes, soft starts and ends, sequences, segments, repetitions
"""
