"""Result of the haptic query: what a tool felt at one pose."""

from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

from hapticdb.query.frame import Answer, Query
from hapticdb.query.law import ForceLaw
from hapticdb.store.base import Object


class Touch:
    """What a tool felt in one frame.

    Attributes
    ----------
    force : (3,) float64
        N, world frame, on the tool.
    torque : (3,) float64
        N m about the tool's centre of mass, world frame.
    hits : (H,) int64
        Indices of the shell's points inside a voxel, ascending.
    depths : (H,) float64
        Depth of each hit in metres, 0 where the law does not feel it: above its tangent plane or,
        under `DistanceField`, where the distance does not grow along the point's normal.
    query : Query
        How the database was asked.
    """

    __slots__ = ("_answer", "_known", "depths", "force", "hits", "query", "torque")

    def __init__(self, answer: Answer, known: Mapping[int, Object]) -> None:
        self._answer = answer
        self._known = known
        self.force: NDArray[np.float64] = answer.wrench[:3]
        self.torque: NDArray[np.float64] = answer.wrench[3:]
        self.hits: NDArray[np.int64] = answer.hits
        self.depths: NDArray[np.float64] = answer.depths
        self.query: Query = answer.query

    @property
    def contacts(self) -> NDArray[np.int64]:
        """Indices (C,) of the shell's points that the law feels, ascending."""
        return self._answer.contacts()[0]

    @property
    def contact_depths(self) -> NDArray[np.float64]:
        """Depths (C,) of the contacts in metres, all above 0."""
        return self._answer.contacts()[1]

    @property
    def contact_points(self) -> NDArray[np.float64]:
        """Places (C, 3) of the contacts, metres, world frame."""
        return self._answer.placed[self.contacts, :3]

    @property
    def contact_normals(self) -> NDArray[np.float64]:
        """Unit normals (C, 3) of the contacts, which point into the tool, world frame."""
        return self._answer.placed[self.contacts, 3:]

    @property
    def law(self) -> ForceLaw:
        """The force law that was felt."""
        return self._answer.law

    @property
    def contact_pairs(self) -> NDArray[np.int64]:
        """Every contact with every object that it touches, (P, 2): index of the point, id."""
        contacts = self.contacts
        if self._answer.touched is not None:
            return self._answer.touched(contacts)
        pairs = self.pairs
        return pairs[np.isin(pairs[:, 0], contacts)]

    @property
    def objects(self) -> list[Object]:
        """Objects of all hits and, under `DistanceField`, those that contacts touch, by id.

        A contact touches the objects that it would feel alone, or the nearest one.
        """
        return [self._known[i] for i in self._answer.ids]

    @property
    def pairs(self) -> NDArray[np.int64]:
        """Every hit with every object in its voxel, (P, 2): index of the point, id."""
        return self._answer.pairs()

    def _repr_html_(self) -> str:
        """Force, torque and what is touched, for notebooks."""
        rows = "".join(
            f"<tr><td>{one.id}</td><td>{escape(one.name)}</td></tr>" for one in self.objects
        )
        return f"<b>{escape(repr(self))}</b><table>{rows}</table>"

    def __repr__(self) -> str:
        x, y, z = self.force
        return (
            f"Touch(force=({x:.4g}, {y:.4g}, {z:.4g}) N, {len(self.hits)} hits, "
            f"{len(self.contacts)} contacts, objects {self._answer.ids})"
        )
