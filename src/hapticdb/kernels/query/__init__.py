"""Kernels of the haptic query: points to keys, keys to ranges, rows to a wrench."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
