"""Numba kernels: arrays in, arrays out; no exceptions, no allocation where a frame waits."""
