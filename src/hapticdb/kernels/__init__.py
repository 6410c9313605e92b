"""Kernels: arrays in, arrays out, compiled by numba.

``from hapticdb.kernels import curves`` gives a module that is loaded when something in it is first
used (`_later`). Kernels themselves import one another by name, at once.
"""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
