"""The experiment: its file, what the file refers to, and whether it may start. Moves nothing.

file.py           pydantic models of the file; parts.py  its parts
labels.py         what a lab finds a run by
load.py           from a file to the experiment with all that it refers to
correction.py     what learning has added to the compensator's input
initial_state.py  what the run before left in the actuator
heat.py           the coil's heat, from run to run; history.py  what the last run left
device_state.py   which run was the last one of a device, kept between runs
check.py          the whole run worked out beforehand, held against device, model and limits
model_range.py    whether the reference stays within what the model was identified on
forecast.py       what a run will do, by all of its commands; whole_run.py  works those out
interlocks.py     interlocks, feedback.py feedback and adaptation.py adaptation, by the file's keys
device.py         the device that it names, from the table of devices
inventory.py      devices on this machine, JSON schema of the file
examples.py       what comes with hilctl, to copy
starting.py       a first experiment for a device
"""
