"""The band of distances around surfaces: its lattice, its packed form, its interpolants."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
