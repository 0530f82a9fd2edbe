"""Simulated actuators behind the contract of a device.

terfenol.py        a Terfenol-D actuator; terfenol_kernel.py  its amplifier, structure and sensor
rods.py            what every physics of its rods is to it
pinned_cells.py    cells with dry friction behind one lag of the field; what the rig had first
domains.py         domains of eight orientations, averaged over their energies
diffusion.py       the field diffuses into conducting rods, shell by shell
jiles_atherton.py  Jiles and Atherton's equations with eddy and excess loss
extras.py          creep, warmth, a second mode, a limited amplifier: options of the rig
piezo.py           a piezo stage
plant.py           what both actuators share
rigs.py            both by their registered names
device.py          blocks, FIFO, faults
"""
