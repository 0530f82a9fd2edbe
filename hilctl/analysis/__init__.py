"""Metrics, reports, replays, plots, pages, exports and the catalogue of recordings."""

PUBLIC = (
    "catalogue", "decimation", "export", "figure_layout", "html", "plot_style", "replay", "report",
    "run_metrics", "response.bode", "response.feedback_design", "response.frequency_response",
    "response.segment_spectrum", "response.step_response", "run_page", "steady_state",
)  # fmt: skip
"""Modules that other rooms import; the others are private."""
