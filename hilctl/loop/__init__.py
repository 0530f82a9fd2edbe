"""The fixed-rate loop: all code that a tick executes, without files, logs or other threads."""

PUBLIC = (
    "adaptation", "block", "compensator", "feedback", "interlocks", "lead_in", "limiter", "loop",
    "on_target", "pacer", "plan", "safe_output", "triggers", "tuning",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
