"""Simulated actuators as devices, and the models of their rods."""
