"""Characterisation: from a connected device and its limits to a validated model."""
