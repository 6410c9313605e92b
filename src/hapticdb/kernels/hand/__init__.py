"""Kernels of the hand: coupling, clutch, and what the loop tells other processes."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
