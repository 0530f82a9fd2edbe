"""Sensors that send unsolicited samples over TCP: profile and session."""
