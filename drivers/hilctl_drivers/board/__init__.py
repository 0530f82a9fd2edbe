"""Microcontroller boards that speak framed messages.

profile.py  what a profile says of one
frames.py   its messages
session.py  one conversation
wire.py     sample by sample
stream.py   from a FIFO
"""
