"""Kernels of resident cells: the table in shared memory, the frames and searches that read it."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
