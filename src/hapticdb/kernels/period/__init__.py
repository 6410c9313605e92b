"""Kernels of the servo loop: one period of a session, for a device loop and a host's worker."""
