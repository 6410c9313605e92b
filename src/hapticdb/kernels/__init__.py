"""Kernels: arrays in, arrays out, compiled by numba.

``from hapticdb.kernels import curves`` gives a lazy module, loaded at its first use (`_later`).
Kernel modules import one another by name, at once.
"""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
