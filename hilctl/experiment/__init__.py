"""The experiment file, everything it refers to, and its check before a run. Moves nothing."""

PUBLIC = (
    "coil_heat", "device_state", "devices", "examples", "file", "forecast", "load",
    "model_validity", "preflight", "rig", "sections.adaptation", "sections.compensator",
    "sections.conditioning", "sections.correction", "sections.coupling", "sections.feedback",
    "sections.labels", "sections.open_loop", "sections.recording_settings", "sections.safe",
    "sections.timing", "state_files", "template",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
