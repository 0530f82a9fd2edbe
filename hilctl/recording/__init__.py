"""MCAP recordings: writing, reading and recovery."""

PUBLIC = (
    "codec", "encoder", "metadata_keys", "reader", "recording", "recording_files", "recover",
    "run_summary", "schema", "time_range", "validation", "writer",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
