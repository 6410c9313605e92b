"""Kernels of surfaces: voxelization, distance bands, sampling, orientation, distances."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
