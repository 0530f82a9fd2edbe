"""Sensors that send samples unasked over TCP: profile, session that takes the newest."""
