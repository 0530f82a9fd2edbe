"""Devices of a package whose own code fails, exits or does not return."""
