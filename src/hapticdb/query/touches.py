"""Results of the haptic query: what a tool felt at one pose, and at many poses."""

from collections.abc import Iterable, Mapping
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.query.frame import Answer, Query
from hapticdb.query.law import ForceLaw
from hapticdb.store.base import Object

CONTACT: np.dtype[np.void] = np.dtype([("pose", "<i8"), ("point", "<i8"), ("depth", "<f8")])
"""A contact in `Touches`: number of the pose, index of the shell's point, depth in metres."""


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

    def __repr__(self) -> str:
        x, y, z = self.force
        return (
            f"Touch(force=({x:.4g}, {y:.4g}, {z:.4g}) N, {len(self.hits)} hits, "
            f"{len(self.contacts)} contacts, objects {self._answer.ids})"
        )


class Touches:
    """What a tool felt at n poses, all of them at one committed revision.

    Attributes
    ----------
    forces : (n, 3) float64
        N, world frame, on the tool.
    torques : (n, 3) float64
        N m about the tool's centre of mass, world frame.
    hits, n_contacts : (n,) int64
        Number of the shell's points inside a voxel, and number of the points that the law feels.
        Under `DistanceField` a contact need not be a hit.
    deepest : (n,) float64
        Depth of the deepest contact in metres, 0 without contacts.
    ids : list of lists of int
        Ids of the objects that each pose's hits are in and, under `DistanceField`, of those that
        its contacts touch, ascending.
    contacts : (C,) array of `CONTACT`, or None
        Every contact: ``pose``, ``point``, ``depth``, ordered by the first two; None when contacts
        were not asked for.
    query : Query
        How the database was asked, all statements together.
    """

    def __init__(self, n_poses: int, *, has_contacts: bool) -> None:
        self.forces: NDArray[np.float64] = np.zeros((n_poses, 3))
        self.torques: NDArray[np.float64] = np.zeros((n_poses, 3))
        self.hits: NDArray[np.int64] = np.zeros(n_poses, dtype=np.int64)
        self.n_contacts: NDArray[np.int64] = np.zeros(n_poses, dtype=np.int64)
        self.deepest: NDArray[np.float64] = np.zeros(n_poses)
        self.ids: list[list[int]] = []
        self.contacts: NDArray[np.void] | None = np.empty(0, CONTACT) if has_contacts else None
        self.query = Query("array", 0, 0, 0, 0.0)
        self._known: Mapping[int, Object] = {}

    def __len__(self) -> int:
        return len(self.forces)

    def __repr__(self) -> str:
        return (
            f"Touches({len(self)} poses, {np.count_nonzero(self.hits)} hit, "
            f"{np.count_nonzero(self.n_contacts)} in contact, {len(self.objects)} objects)"
        )

    @property
    def objects(self) -> list[Object]:
        """Objects of all hits and, under `DistanceField`, of all contacts, at all poses, by id."""
        return [self._known[i] for i in sorted({i for ids in self.ids for i in ids})]

    def gather(self, answers: Iterable[Answer]) -> Self:
        """Collect the answers of all poses, in their order."""
        pieces = [np.empty(0, CONTACT)]
        total = self.query
        for n, answer in enumerate(answers):
            self.forces[n], self.torques[n] = answer.wrench[:3], answer.wrench[3:]
            self.hits[n], self.n_contacts[n] = len(answer.hits), answer.n_contacts
            self.deepest[n] = answer.deepest
            self.ids.append(answer.ids)
            asked = answer.query
            total = Query(
                asked.strategy,
                total.statements + asked.statements,
                total.ranges + asked.ranges,
                total.rows + asked.rows,
                0.0,
            )
            if self.contacts is not None:
                points, depths = answer.contacts()
                piece = np.empty(len(points), CONTACT)
                piece["pose"], piece["point"], piece["depth"] = n, points, depths
                pieces.append(piece)
        if self.contacts is not None:
            self.contacts = np.concatenate(pieces)
        self.query = total
        return self

    def name(self, known: Mapping[int, Object], elapsed_us: float) -> Self:
        """Set the objects of the revision that was read, and the time of all poses."""
        self._known = known
        self.query = self.query._replace(elapsed_us=elapsed_us)
        return self
