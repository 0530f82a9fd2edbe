"""The processes around one loop: start, shared memory, recording, requests, recovery."""

PUBLIC = (
    "assemble", "control.client", "metadata", "probe", "recovery", "result",
    "run_folder", "safety.manual_safe", "shared.ring", "shared.shared_page", "start",
    "unpaced",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
