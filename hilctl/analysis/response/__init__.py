"""Frequency response: measurement and fit, Bode plot and page."""
