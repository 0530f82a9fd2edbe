"""Microcontroller boards with binary frames: profile, messages, session, and ``serial_dac``."""
