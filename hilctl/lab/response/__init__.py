"""Frequency and step responses, spectra, feedback design: measurement, fit, plots and pages."""

PUBLIC = (
    "bode", "feedback_design", "fir_fit", "frequency_response", "segment_spectrum", "step_response",
)  # fmt: skip
"""Modules that other packages import; the others are private."""
