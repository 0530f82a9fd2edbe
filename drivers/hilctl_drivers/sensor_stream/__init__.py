"""Sensors that send samples unasked over TCP: profile, and the reader of the newest sample."""
