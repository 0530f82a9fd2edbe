"""Frequency and step responses: measurement and fit, feedback design, plots and pages."""
