"""Kernels of the hand: the coupling to the tool, direct rendering, scale and clutch."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
