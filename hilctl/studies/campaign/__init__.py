"""Many runs of one experiment, each with other values of its keys: what is run, kept, and found.

The recordings are the checkpoint: a whole one of the very experiment that a step would run is that
step done. So a campaign that was killed loses one run, and the same command goes on from there.

file.py        what a campaign file may say
vary.py        pure: values and ranges of keys, crossed or together, and their order
steps.py       the steps in order, each as settings over the base experiment
plan.py        every step held against device, model and limits; time, heat and disk
table.py       CSV and Parquet of all steps
folder.py      the recordings in a campaign's folder, and who works on it
session.py     the runs, one after the other in real time; fast.py  at once, on simulated devices
"""
