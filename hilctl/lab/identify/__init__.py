"""Models from measured data.

``pipeline`` turns records into an evaluated model. ``registry`` finds the fit of a kind of model,
``settings`` has their settings, ``fit_api`` the types of a fit, ``fit_data`` its prepared records.
``refinement`` compares a model of runs with the one that they used.

data        loops and histories from recordings and tables
searched    play models whose thresholds are searched from several starts
staged      free weights and stages for steady loops
field       effective field and generalised Duhem operator for histories
literature  other models of the literature
"""

PUBLIC = (
    "data.cycles", "data.data_files", "data.records", "evaluation", "fit_api", "fit_data",
    "fit_model", "model_page", "model_quality", "model_selection", "parallel", "pipeline",
    "refinement", "registry", "settings", "summary",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
