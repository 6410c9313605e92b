"""Clusters of large tools that sleep while they are far from everything, and budgets of points."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
