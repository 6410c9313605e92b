"""Kernels of surfaces: triangles to voxels and bricks, points on a surface, its inside."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
