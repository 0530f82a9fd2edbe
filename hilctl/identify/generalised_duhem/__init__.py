"""Fit of the generalised Duhem operator to whole histories."""
