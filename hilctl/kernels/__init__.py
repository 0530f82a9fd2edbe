"""Compiled hysteresis operators, and what else is worked out sample by sample: pure functions.

Rules of this folder: explicit signatures, no globals, no objects, state passed in and updated in
place, and every kernel stands in one file with all that it calls, because numba's on-disk cache
does not notice a callee that changed in another file. Units live one level above.

    jit.py       the one decorator; elsewhere.py: compiles in a process of its own
    hysteresis.py  play, stop, deadband, their sums, the integrated model and its inverse
    implicit.py  operators whose inverse is found root by root: Preisach, KP, Bouc-Wen, Duhem
    envelope.py  play operators between envelopes
    field.py     plays and drags of an effective field, its losses, and their inverse
    residual.py  plays, drags and rate of a modelled displacement, and what undoes them
    dynamics.py  field lag, structure, delay, creep and modes, and their inverses
    tick.py      a tick's kernels one after another, called by their addresses
    atomics.py   numbers in shared memory that say of other data that they are there
    limit.py     peak and slew limits of a command
    interlock.py what ends a run, looked at in every sample
    packed.py    messages of a recording's chunk, and their packed lists
"""
