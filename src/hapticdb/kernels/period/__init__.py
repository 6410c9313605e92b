"""Kernels of a loop: one period of a hand, as a session's loop and a host's worker run it."""
