"""Models from measured data.

pipeline.py is the way through: records in, an evaluated model out. catalogue.py registers every
kind of model, settings.py its settings, job.py the types of a fit.

data               loops and histories, from recordings and tables
searched           thresholds searched from several starts
staged             free weights and stages; what is linear needs no search
field              plays and drags of an effective field, from whole histories
generalised_duhem  slopes by place and direction, from whole histories
literature         other models of the literature
refine             a better model from recordings of its use
"""
