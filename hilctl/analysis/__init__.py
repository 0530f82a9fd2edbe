"""Metrics, reports, replays, plots, pages, exports and the catalogue of recordings."""
