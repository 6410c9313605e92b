"""A sample without a download: a car of 217 parts, a spanner, and a path of it over the car.

The files are data of the package, compressed. Parts of the car that are instances of one shape
share its triangles. World frame of the car: metres, right-handed, x forward, z up; the origin on
the ground between the wheels.
"""

from hapticdb.sample.write import SampleFiles, write_sample

__all__ = ["SampleFiles", "write_sample"]
