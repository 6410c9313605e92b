"""Kernels of the hand: coupling, clutch, and the report of the servo loop to other processes."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
