"""Simulated actuators behind the contract of a device.

terfenol.py        a Terfenol-D actuator and its options; terfenol_kernel.py  its compiled steps
pinned_cells.py    cells with dry friction behind one lag of the field
domains.py         domains of eight orientations, averaged over their energies
diffusion.py       the field diffuses into conducting rods, shell by shell
jiles_atherton.py  Jiles and Atherton's equations with eddy and excess loss
piezo.py           a piezo stage
plant.py           the base of both actuators, and of every physics of the rods
rigs.py            both actuators as devices: blocks, FIFO, injected faults
"""
