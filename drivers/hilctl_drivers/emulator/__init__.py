"""The simulated rig behind real wires: emulated devices, register by register.

What a driver sees over TCP or a pty is what the profile's device would show; short of the magnet,
all of a run is real.
"""
