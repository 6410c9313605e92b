"""Result of the haptic query at one pose."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.query.law import PLANE, ForceLaw
from hapticdb.store.base import Object
from hapticdb.units import notebook_html

PairsOf = Callable[[ForceLaw, NDArray[np.int64]], NDArray[np.int64]]
"""All pairs (P, 2) of a point and an object id in contact under a law, of points (C,) of a
frame."""


class Query(NamedTuple):
    """Figures of a frame's database query.

    strategy : the strategy used, never `auto`; statements : SQL statements run, 0 if all bricks
    were in memory; ranges : index ranges, single keys included; rows : rows read, false hits
    included; elapsed_us : of the frame.
    """

    strategy: str
    statements: int
    ranges: int
    rows: int
    elapsed_us: float


@dataclass(eq=False, repr=False, slots=True)
class Touch:
    """Contact force, hits and objects of a tool in one frame."""

    force: NDArray[np.float64]
    """(3,) N, world frame, on the tool."""
    torque: NDArray[np.float64]
    """(3,) N m about the tool's centre of mass, world frame."""
    hits: NDArray[np.int64]
    """Indices (H,) of the shell's points inside a voxel, ascending."""
    depths: NDArray[np.float64]
    """Depth (H,) of each hit in metres, 0 for a hit without a force."""
    ids: list[int]
    """Ids of `objects`."""
    law: ForceLaw
    """The force law."""
    query: Query
    """Figures of the database query."""
    _apart: tuple[NDArray[np.int64], NDArray[np.float64]]
    """Contacts that are no hits, and their depths, above 0."""
    _placed: NDArray[np.float64]
    _pairs_of: PairsOf
    _known: Mapping[int, Object]

    @property
    def contacts(self) -> NDArray[np.int64]:
        """Indices (C,) of the shell's points with a force, ascending."""
        return self._felt()[0]

    @property
    def contact_depths(self) -> NDArray[np.float64]:
        """Depths (C,) of the contacts in metres, all above 0."""
        return self._felt()[1]

    @property
    def contact_points(self) -> NDArray[np.float64]:
        """Positions (C, 3) of the contacts, metres, world frame."""
        return self._placed[self.contacts, :3]

    @property
    def contact_normals(self) -> NDArray[np.float64]:
        """Unit normals (C, 3) of the contacts, into the tool, world frame."""
        return self._placed[self.contacts, 3:]

    @property
    def contact_pairs(self) -> NDArray[np.int64]:
        """Every contact with every object in contact there, (P, 2): index of the point, id."""
        return self._pairs_of(self.law, self.contacts)

    @property
    def objects(self) -> list[Object]:
        """Objects of all hits and, under `DistanceField`, of contacts, by id.

        The objects of a contact are those with a force by themselves, or the nearest one.
        """
        return [self._known[i] for i in self.ids]

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Every hit with every object in its voxel, (P, 2): index of the point, id."""
        return self._pairs_of(PLANE, self.hits)

    def _felt(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Contacts and their depths; some may be no hits."""
        is_included = self.depths > 0
        points, depths = self.hits[is_included], self.depths[is_included]
        apart, apart_depths = self._apart
        if apart.size:
            points = np.concatenate([points, apart])
            order = np.argsort(points)
            points, depths = points[order], np.concatenate([depths, apart_depths])[order]
        return points, depths

    def _repr_html_(self) -> str:
        """Force, torque and objects, for notebooks."""
        return notebook_html(self, ((one.id, one.name) for one in self.objects))

    def __repr__(self) -> str:
        x, y, z = self.force
        return (
            f"Touch(force=({x:.4g}, {y:.4g}, {z:.4g}) N, {len(self.hits)} hits, "
            f"{len(self.contacts)} contacts, objects {self.ids})"
        )
