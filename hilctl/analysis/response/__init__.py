"""Frequency and step responses: measurement and fit, Bode plot and page."""
