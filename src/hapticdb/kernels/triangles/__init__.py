"""Kernels on pairs of surfaces: distances, on a path, too, and penetration depth.

`triangle_distance` measures two triangles, `surface_distance` two BVHs, `path_distance` two BVHs on
a path, which `path_motion` moves; `depth` searches the deepest place of one surface in the closed
bodies of another; `offsets` moves its corners.
"""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
