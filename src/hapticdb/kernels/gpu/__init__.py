"""GPU kernels, from the leaves of the CPU kernels compiled for CUDA."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
