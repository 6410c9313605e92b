"""Mesh, CAD and point-cloud files as parts: name, triangles or points in metres, placement.

Light to import: a format's libraries load only in the parser process.
"""

from hapticdb.mesh.parse import READERS
from hapticdb.mesh.part import Defects, MeshFile, Part
from hapticdb.mesh.reader import parse_in_process, read_file
from hapticdb.units import UNITS

SUFFIXES = tuple(READERS)
"""Supported suffixes, in lower case."""

__all__ = ["SUFFIXES", "UNITS", "Defects", "MeshFile", "Part", "parse_in_process", "read_file"]
