"""Frequency and step responses, spectra, feedback design: measurement, fit, plots and pages."""
