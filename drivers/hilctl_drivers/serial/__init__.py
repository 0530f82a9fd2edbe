"""DACs on serial lines: text and framed messages.

options.py  an experiment's options
setup.py    held against the profile
device.py   the device
"""
