"""The experiment file, everything it refers to, and its check before a run. Moves nothing."""

PUBLIC = (
    "adaptation", "axes", "coil_heat", "compensator", "conditioning", "correction", "device_state",
    "devices", "examples", "feedback", "file", "forecast", "labels", "load", "model_validity",
    "open_loop", "preflight", "recording_settings", "rig", "safe", "state_files", "template",
    "timing",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""
