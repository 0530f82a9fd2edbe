"""MCAP recordings: writing, reading and recovery."""
