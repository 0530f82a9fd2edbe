"""Campaigns: runs of one experiment over a grid of parameters.

file.py                 campaign file, varied values and their order
steps.py                steps in order, each as settings over the base experiment
plan.py                 checks of every step; time, heat and disk space
store.py                recordings in a campaign's folder
table.py                CSV and Parquet of all steps
campaign_runner.py      runs in real time
parallel_simulation.py  runs of simulated devices in parallel, without real time
"""
