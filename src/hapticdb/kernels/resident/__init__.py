"""Kernels of resident cells: the table in shared memory, with its frames and searches."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
