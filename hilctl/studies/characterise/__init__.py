"""From a wired device and its limits to a model: what is run, what is measured, what comes of it.

limits.py      what the experiment allows: range, slew, stroke, heat, and the band of frequencies
waveforms.py   pure: the waveform of each step, as keys of an experiment
steps.py       the steps in order: what each is for, how long it takes, what is taken from it
noise.py       pure: noise, drift and the first reaction
response.py    pure: small-signal response; gain, delay, lag and resonance that explain it
loops.py       pure: loops, reversal curves, what repeats, and how far amplitudes may grow
problem.py     what ends a campaign, each with what to do about it
modelling.py   the model, and how far it is from a reference that it has not seen
results.py     all that was found, and the verdict
session.py     the steps, one run each; those that stand in the folder already are not run again
plots.py       figures; page.py  the page
"""
