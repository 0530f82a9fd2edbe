"""Hysteresis models: parameters, their conditions, and streaming operators.

base.py           common parts of all models; the streaming operator
plays.py          sums of plays and their inverses: PPI, RDPI, SPI, generalised PI
integrated.py     plays and deadbands; the butterfly model; the published parametrisation
implicit_models.py  models with a numeric inverse: Preisach, KP, Bouc-Wen, Duhem
generalised_duhem.py, effective_field.py  models of rods, for staged.py
linear_stages.py  chains, delays, smoothing, structure, creep
staged.py         hysteresis between linear stages
refined.py        a model and its identified residual
model_file.py     model files
model_export.py   models as one C or MATLAB function
kernel_translation.py  kernels in C and MATLAB
"""
