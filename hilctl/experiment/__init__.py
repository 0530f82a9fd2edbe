"""The experiment file, everything it refers to, and its check before a run. Moves nothing.

file.py           the experiment file as a model, its sections and JSON schema
load.py           an experiment with its device, model and correction
devices.py        devices by name
preflight.py      the check of an experiment: all rules and the complete commands
device_rules.py   rules between an experiment and its device
conditioning.py   rules and commands of the ``condition`` section
closed_loop.py    rules and settings of the ``feedback`` and ``adaptation`` sections
open_loop.py      open loop of the feedback and its margins, from a measured or assumed response
model_validity.py comparison of the reference with the motions the model was identified on
forecast.py       the commands of a run in numbers
device_state.py   the last run of each device, and the initial state of the compensator
coil_heat.py      heat of the coil through runs and pauses
correction.py     correction by iterative learning
template.py       a first experiment for a device
examples.py       shipped examples and copies of them
"""

PUBLIC = (
    "closed_loop", "coil_heat", "conditioning", "correction", "device_rules", "device_state",
    "devices", "examples", "file", "forecast", "load", "model_validity", "open_loop", "preflight",
    "template",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""
