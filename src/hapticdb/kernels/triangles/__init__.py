"""Kernels on pairs of surfaces: how far apart they are, and how deep they overlap.

`pairs` measures two triangles, `nearest` two trees of them; `piercing` finds edges that go through,
`parting` measures how far the pieces get that they leave.
"""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
