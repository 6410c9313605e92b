"""Kernels on pairs of surfaces: distances, on a path, too, and penetration depth.

`pairs` measures two triangles, `nearest` two BVHs, `sweeping` two BVHs on a path; `depth` searches
the deepest place of one surface in the closed bodies of another; `offsets` moves its
corners.
"""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
