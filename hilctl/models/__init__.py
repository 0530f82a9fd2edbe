"""Hysteresis models: parameters, their conditions, and operators that stream.

base.py        what every model has; the streaming operator
plays.py       sums of plays and their inverse: the Prandtl-Ishlinskii model (PPI), and the
               rate-dependent one (RDPI); a PPI compensated by stop operators (SPI)
deadband.py    memoryless function of deadband operators and its inverse
integrated.py  the integrated model: RDPI, then deadbands, and its inverse; its published
               parametrisations
butterfly.py   plays, then an even function: rods without bias, inverted on one side
staged.py      field lag, hysteresis, structure, delay, creep, and their inverse; chain.py joins
               them, and undoes the structure
structure.py   the structure's first mode; further ones, and their exact inverse
creep.py       creep of a displacement, and its exact inverse
generalised.py generalised PI model: plays between envelopes, and its inverse
numeric_inverse.py  models whose inverse is found root by root: preisach.py, kp.py
               (Krasnosel'skii-Pokrovskii), bouc_wen.py, duhem.py
field.py       plays and drags of an effective field, a curve, losses; for staged.py
generalised_duhem.py  slopes by place and direction, all over a band, with losses; for staged.py
refined.py     a model and what runs have shown beyond it, with the inverse of both
files.py       model files, in and out
"""
