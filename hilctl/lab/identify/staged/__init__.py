"""Fits of free weights and stages to steady loops."""
