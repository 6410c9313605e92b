"""Files to parts: name, triangles or points in metres, placement.

Light to import: a format's libraries load in the child process that parses.
"""

from hapticdb.mesh.parse import READERS
from hapticdb.mesh.part import Defects, MeshFile, Part
from hapticdb.mesh.reader import parse_in_process, read_file
from hapticdb.units import UNITS

SUFFIXES = tuple(READERS)
"""Suffixes of files that can be read, in lower case."""

__all__ = ["SUFFIXES", "UNITS", "Defects", "MeshFile", "Part", "parse_in_process", "read_file"]
