"""Measured data in, model parameters out.

command.py       the command: request.py asks for it, summary.py and page.py show it
files.py         recordings and tables in, model files out
data.py          steady loops and whole time histories
cycles.py        loops from recordings and from histories that repeat
period.py        the period of a command, and where it is steady
tables.py        histories from text tables
settings.py      choices of a fit; the published ones
identify.py      identify a model
fit.py           what was found, and how far a model is from data
describe.py      what a model file says of how its model was found
model_size.py      number of plays by loops held out; lag of a table
workers.py       independent fits over threads, processes or a Dask cluster
geometry.py      weights by hysteresis

Weights that are searched, from several starts:
bench.py         all data ready for the kernels
plays.py         PPI and RDPI as a search problem
integrated.py    the integrated model with exponential weights as a search problem
search.py        least squares from several starts; refinement for the peak error
butterfly.py     plays and an even function, for actuators without a bias
linear.py        weights by bounded linear least squares

Free weights and stages, without a search for what is linear:
staged_bench.py  all data ready for lag, plays, structure and delay
sensitivity.py   kernels of lag and plays with their derivatives
convex.py        weights of plays and deadbands by one non-negative least-squares problem
layered.py       all parameters in one row, errors and derivatives
descend.py       bounded least squares with analytic derivatives
staged.py        from a few starts to the parameters; refinement for the peak error
staged_model.py  from parameters to a model; a model's response to the data
triangle.py      a Preisach triangle between stages that are known
confidence.py    standard errors of the parameters
"""
