"""Hysteresis models: parameters, their conditions, and streaming operators."""
