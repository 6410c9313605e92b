"""Haptic devices: the protocol, scripted, simulated and vendors' devices."""
