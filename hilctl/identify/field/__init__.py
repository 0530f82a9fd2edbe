"""Fit of the effective-field model to whole histories.

fits.py      from a job to a model
prepared.py  records as the fit needs them: thinned, smoothed, displacement without its structure
columns.py   kernels: which samples matter, how far loops go, and what plays of each cell give
rows.py      which samples are rows of a fit, and how much each of them counts
weights.py   densities and output curve by one non-negative least-squares problem
stages.py    losses, structure and delay: in a row for the search, out of it for a model
descent.py   a sum of squares followed down
search.py    from a few starts to the stages, then stages and thresholds together
"""
