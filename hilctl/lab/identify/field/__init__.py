"""Fits of the effective-field model and the generalised Duhem operator to histories."""
