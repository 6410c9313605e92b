"""Kernels of the graphics processor: the leaves of the others, compiled for it."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
