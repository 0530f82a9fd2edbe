"""hilctl: a real-time hardware-in-the-loop compensator for smart-material actuators."""

__version__ = "0.1.0"
