"""Simulated actuators behind the contract of a device.

terfenol.py  a Terfenol-D rig; terfenol_kernel.py  its physics, compiled
piezo.py     a piezo stage
plant.py     what both share
rigs.py      both by their registered names
device.py    blocks, FIFO, faults
"""
