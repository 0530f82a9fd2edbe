"""Microcontroller boards that speak framed messages.

profile.py  what a profile says of one
frames.py   its messages
session.py  one conversation
wire.py     sample by sample, and through a FIFO
"""

LINK_KINDS = {"frames": f"{__name__}.board_profile:FrameProfile"}
"""What a profile's ``link.kind`` says of it: where the class of such profiles stands."""
