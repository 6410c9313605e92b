"""A sample made from nothing: a car of about two hundred parts, a spanner, and a path.

Everything is computed from parametric shapes, so that the demo needs no download, and comes out
the same, byte for byte, on every run.
"""

from hapticdb.sample.car import build_car
from hapticdb.sample.parts import SamplePart
from hapticdb.sample.path import slide_over_voxels, slide_path
from hapticdb.sample.wrench import build_wrench
from hapticdb.sample.write import SampleFiles, write_sample, write_wrench

__all__ = [
    "SampleFiles",
    "SamplePart",
    "build_car",
    "build_wrench",
    "slide_over_voxels",
    "slide_path",
    "write_sample",
    "write_wrench",
]
