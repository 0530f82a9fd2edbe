"""Hysteresis models: parameters, their conditions, and operators that stream.

base.py        what every model has; the streaming operator
ppi.py         Prandtl-Ishlinskii model of plays (PPI) and its inverse
spi.py         stop-operator compensator of a PPI
rdpi.py        rate-dependent Prandtl-Ishlinskii model (RDPI) and its inverse
deadband.py    memoryless function of deadband operators and its inverse
integrated.py  the integrated model: RDPI, then deadbands, and its inverse
butterfly.py   plays, then an even function: rods without bias, inverted on one side
staged.py      field lag, hysteresis, structure, delay, and their inverse; chain.py joins them,
               smoothing.py undoes the structure
generalised.py generalised PI model: plays between envelopes, and its inverse
numeric_inverse.py  models whose inverse is found root by root: preisach.py, kp.py
               (Krasnosel'skii-Pokrovskii), bouc_wen.py, duhem.py
published.py   parametrisations and parameter sets from the literature
files.py       model files, in and out
"""
