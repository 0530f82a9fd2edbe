"""Sensors that send samples unasked over TCP: profile, and the reader of the newest sample."""

LINK_KINDS = {"sensor_stream": f"{__name__}.stream_profile:StreamProfile"}
"""Class of profiles per ``link.kind``."""
