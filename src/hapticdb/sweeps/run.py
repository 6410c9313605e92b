"""Sweep: moves a tool along a path, and says exactly what it hits, or how near it comes.

The objects' boxes say which of them may be near the path, never too few. Their surfaces decide.
"""

import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.errors import ConnectionLostError, UsageError
from hapticdb.kernels.surfaces.sides import TriangleTree, triangle_tree
from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.orientation import Surface, orient
from hapticdb.pointshell.shell import PointShell
from hapticdb.proportions import Proportions, compare_proportions
from hapticdb.store.base import Object
from hapticdb.store.finding import Words
from hapticdb.sweeps.contact import Followed, follow
from hapticdb.sweeps.cut import Mesh
from hapticdb.sweeps.gap import MEETING, Least, OverTimeError, Pair, error_of
from hapticdb.sweeps.near import Near, boxes_along
from hapticdb.sweeps.result import Gap, Place, Profile, Swept, Touching
from hapticdb.sweeps.way import Way

CONTACT = 5e-5
"""Default of the contact tolerance, metres."""
WINDOWS = 256
"""Places of a path's profile. Larger: a finer profile, more time."""

Floats = NDArray[np.float64]
