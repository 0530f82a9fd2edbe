"""Fits of free weights and stages: what is linear needs no search.

fits.py         from a job to a model; a Preisach triangle between known stages
fit_data.py     all data ready for lag, plays, structure and delay
sensitivity.py  kernels of lag and plays with their derivatives
convex.py       weights of plays and deadbands by one non-negative least-squares problem
layered.py      all parameters in one row, errors and derivatives
descend.py      bounded least squares with analytic derivatives
search.py       from a few starts to the parameters; refinement for the peak error
model.py        from parameters to a model; a model's response to the data
confidence.py   standard errors of the parameters
"""
