"""Hands: what a device is and may say, scripted and simulated devices, vendors' devices."""
