"""Fit of the generalised Duhem operator to whole histories.

fits.py      from a job to a model
signals.py   field and displacement by what the stages are; the stages in a row for the search
tables.py    nodes of a table of slopes, laid over a path; a table's prior
search.py    table and stages together, by damped Gauss-Newton steps
"""
