"""The experiment file, everything it refers to, and its check before a run. Moves nothing."""

PUBLIC = (
    "closed_loop", "coil_heat", "conditioning", "correction", "device_rules", "device_state",
    "devices", "examples", "file", "forecast", "load", "model_validity", "open_loop", "preflight",
    "state_files", "template",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""
