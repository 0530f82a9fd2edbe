"""Experiments of several runs.

step_runner.py  what campaign and characterisation share: host, disk space, cooling, progress
campaign/       runs of one experiment over a grid of parameters
characterise/   measure a connected actuator, then identify and validate a model
multi_run/      reports of many runs
"""
