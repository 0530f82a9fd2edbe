"""Devices with text (SCPI, GCS, DCON) or fixed frames: profile, session, and ``serial_dac``."""
