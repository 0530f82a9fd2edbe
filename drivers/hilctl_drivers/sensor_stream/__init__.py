"""Sensors that send unsolicited samples: profile and session."""
