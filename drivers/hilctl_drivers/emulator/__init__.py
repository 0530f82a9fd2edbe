"""Emulated devices: the simulated rig behind real TCP connections and ptys."""
