"""Devices that a hand holds: the protocol, scripted, simulated and vendors' devices."""
