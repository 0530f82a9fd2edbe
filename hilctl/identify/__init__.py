"""Measured data in, model parameters out.

files.py       recordings and tables in, model files out
data.py        steady loops and whole time histories
cycles.py      loops from recordings and from histories that repeat
period.py      the period of a command, and where it is steady
tables.py      histories from text tables
settings.py    choices of a fit; the published ones
fitting.py     identify a model
fit.py         what was found, and how far a model is from data
bench.py       all data ready for the kernels
plays.py       PPI and RDPI as a search problem
integrated.py  the integrated model as a search problem
linear.py      weights by bounded linear least squares
search.py      least squares from several starts; refinement for the peak error
geometry.py    area and peak hysteresis of loops; weights by hysteresis
"""
