"""Compiled per-sample arithmetic: pure functions of plain arrays.

Rules: exact types in annotations, no globals, no objects; state is an argument, updated in place. A
kernel and all kernels that it calls are in one file, because numba's on-disk cache does not detect
a changed callee in another file. Kernels of models use only the syntax that
:mod:`hilctl.lab.model_export.kernel_translation` translates to C and MATLAB.
"""
