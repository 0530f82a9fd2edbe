"""Measured data in, model parameters out.

command.py     identify from files, with further modes; summary.py and page.py show what was found
settings.py    every choice of a fit, once; the published ones
catalogue.py   every kind of model: its name, how it is identified, what data that takes
fit_model.py   fit a model of any kind, with its provenance
job.py         what a fit takes, and what it returns
judge.py       how far a model is from data; weights of loops by hysteresis
held_out.py    the same on data that its fit did not see
verdict.py     what a model is worth, or why it is none
found_range.py the motions that it was identified on
creep.py       creep, from rests; modes.py: further modes of the structure, from what a model leaves
candidates.py  the kind of model that does best on data held out
model_size.py  number of plays by loops held out; lag of a table
workers.py     independent fits over threads, processes or a Dask cluster
fit_data.py    all data ready for the kernels
linear.py      weights by bounded linear least squares; densities held smooth

data           loops and histories, from recordings and tables
searched       thresholds searched from several starts
staged         free weights and stages, without a search for what is linear
field          plays and drags of an effective field, from whole histories
generalised_duhem  slopes by place and direction, from whole histories
refine         a better model from recordings of its use
literature     the other models of the literature
"""
