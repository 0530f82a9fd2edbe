"""Simulated actuators.

devices.py         both actuators as devices, with injected faults
actuator_base.py   base of the actuators and of all rod models
terfenol.py        Terfenol-D actuator; terfenol_kernel.py has its compiled steps
piezo.py           piezo stage
pinned_cells.py    rod model: cells with dry friction
domains.py         rod model: domains of eight orientations
diffusion.py       rod model: field diffusion in conducting rods
jiles_atherton.py  rod model: Jiles-Atherton with eddy and excess losses
"""
