"""Hysteresis models: parameters, their conditions, and operators that stream.

base.py        what every model has; the streaming operator
ppi.py         Prandtl-Ishlinskii model of plays (PPI) and its inverse
spi.py         stop-operator compensator of a PPI
rdpi.py        rate-dependent Prandtl-Ishlinskii model (RDPI) and its inverse
deadband.py    memoryless function of deadband operators and its inverse
integrated.py  the integrated model: RDPI, then deadbands, and its inverse
published.py   parametrisations and parameter sets from the literature
files.py       model files, in and out
"""
