"""LAS and LAZ through laspy: one point cloud named after the file."""

from pathlib import Path

import laspy
import numpy as np

from hapticdb.mesh.raw import Parsed, Shape, UnreadableError, placed_once


def read(path: Path) -> Parsed:
    """Points of a LAS or LAZ file, in the unit of its coordinates."""
    with laspy.open(path) as reader:
        promised = reader.header.point_count
        points = reader.read()
    if len(points) != promised:
        raise UnreadableError(
            f"it is cut short: its header promises {promised:,} points, {len(points):,} are there"
        )
    return placed_once([(path.stem, Shape(np.asarray(points.xyz), None))])
