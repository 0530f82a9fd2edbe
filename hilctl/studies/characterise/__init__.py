"""Characterisation: from a connected device and its limits to a validated model.

limits.py      range, slew, stroke, heat and frequency band that the experiment allows
waveforms.py   waveform of each step, as keys of an experiment
steps.py       steps in order: waveform, evaluation and problems of the rig
response.py    noise at rest, first reaction, small-signal response
loops.py       loops, reversal curves, repeatability, growth of amplitudes
results.py     results, model and validation
characterisation_runner.py  runs all steps; completed ones are kept
rig_page.py    page and figures
"""
