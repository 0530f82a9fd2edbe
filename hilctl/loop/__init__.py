"""The fixed-rate loop: everything that a tick executes; no file, no log, no other thread."""

PUBLIC = (
    "adaptation", "block", "compensator", "feedback", "interlocks", "lead_in", "limiter", "loop",
    "pacer", "plan", "safe_output", "triggers", "tuning",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""
