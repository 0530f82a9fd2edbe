"""Experiments of several runs."""

PUBLIC = (
    "calibrate", "campaign.campaign_runner", "campaign.plan", "campaign.steps", "campaign.store",
    "characterise.characterisation_runner", "characterise.results", "characterise.rig_page",
    "couple", "learn", "multi_run.collect", "multi_run.multi_run_page", "multi_run.plots",
    "multi_run.varied_parameter", "study", "study_folder",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
