"""Models of the literature beside the integrated model: found, run and judged alike.

catalogue.py     the models by name, and how each is found
data.py          loops, and what all fits need to know of them
operators.py     fits by non-negative least squares: Preisach, Krasnosel'skii-Pokrovskii
asymmetric.py    fit of the rate-independent integrated model
envelopes.py     fit of the generalised Prandtl-Ishlinskii model
differential.py  fits of Bouc-Wen and Duhem
judging.py       model error loop by loop; time a sample
trials.py        each inverse before a simulated device, in this process
compare.py       all of it together
summary.py       the table's texts
figure.py        the figure
page.py          both as one page
saving.py        each model as a file, ready to run
"""
