"""The band of unsigned distances: lattice, packed form, interpolants, force law."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
