"""Devices that speak lines of text: SCPI, DCON and their like.

profile.py  what a profile says of one
lines.py    lines and the numbers in them
timing.py   how long they take
session.py  one conversation
wire.py     sample by sample
"""
