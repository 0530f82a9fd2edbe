"""Metrics, reports, replays, exports and the catalogue of recordings."""

PUBLIC = (
    "catalogue", "contour", "export", "export_files", "replay", "report", "run_metrics",
    "steady_state", "tick_lateness",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
