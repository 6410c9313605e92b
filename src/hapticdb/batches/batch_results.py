"""Results of batches: an entry for each pose, in the given order."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.array_types import Floats, Ints
from hapticdb.errors import UsageError
from hapticdb.query.law import ForceLaw
from hapticdb.store.base import Object
from hapticdb.tabular.schema import WRENCH, record
from hapticdb.tabular.tables import Columns, Tabular, columns_of
from hapticdb.units import notebook_html


class TouchedIds(NamedTuple):
    """Objects in contact at the poses of a batch.

    offsets (B + 1,) int64; ids (P,) int64: those of pose n are ids[offsets[n]:offsets[n + 1]],
    ascending; known : the environment's objects by id, at the batch's revision.
    """

    offsets: Ints
    ids: Ints
    known: Mapping[int, Object]


class TouchBatch(Tabular):
    """Contact forces of a tool at B poses, all of them at one committed revision.

    forces (B, 3) float64 : N, world frame, on the tool
    torques (B, 3) float64 : N m about the tool's centre of mass, world frame
    hits, n_contacts (B,) int64 : numbers of the shell's points inside a voxel, and of its points
        with a force. Under `DistanceField` a contact need not be a hit.
    deepest (B,) float64 : depth of the deepest contact in metres, 0 without contacts
    law : the force law
    revision : revision of the environment
    """

    def __init__(self, n_poses: int, law: ForceLaw) -> None:
        self.forces: Floats = np.zeros((n_poses, 3))
        self.torques: Floats = np.zeros((n_poses, 3))
        self.hits: Ints = np.zeros(n_poses, dtype=np.int64)
        self.n_contacts: Ints = np.zeros(n_poses, dtype=np.int64)
        self.deepest: Floats = np.zeros(n_poses)
        self.law = law
        self.revision = 0
        self.named: TouchedIds | None = None

    def __len__(self) -> int:
        return len(self.forces)

    def __repr__(self) -> str:
        most = np.linalg.norm(self.forces, axis=1).max(initial=0.0)
        return (
            f"TouchBatch({len(self)} poses, {np.count_nonzero(self.hits)} hit, "
            f"{np.count_nonzero(self.n_contacts)} in contact, at most {most:.4g} N, "
            f"revision {self.revision})"
        )

    def _repr_html_(self) -> str:
        """Greatest force, torque and depth, each with its pose, for notebooks."""
        measures = {
            "force, N": np.linalg.norm(self.forces, axis=1),
            "torque, N m": np.linalg.norm(self.torques, axis=1),
            "depth, m": self.deepest,
        }
        rows = (
            (name, f"{values.max():.4g}", f"at pose {values.argmax()}")
            for name, values in measures.items()
            if len(values)
        )
        return notebook_html(self, rows)

    def columns(self, first: int = 0) -> Columns:
        """A row for each pose, numbered from `first` on; objects in contact if they are known."""
        numbers = (
            np.arange(first, first + len(self)), *map(np.ascontiguousarray, self.forces.T),
            *map(np.ascontiguousarray, self.torques.T), self.hits, self.n_contacts, self.deepest,
            np.full(len(self), self.revision),
        )  # fmt: skip
        names = ("pose", *WRENCH, "hits", "contacts", "deepest_m", "revision")
        found = dict(zip(names, numbers, strict=True))
        if self.named is None:
            return found
        known = self.named.known
        touched = ([record(known[i], "id name") for i in self.ids_at(n)] for n in range(len(self)))
        return found | columns_of(["touched"], ({"touched": one} for one in touched))

    @property
    def offsets(self) -> Ints:
        """Start of each pose's ids in `ids`, and the end of the last ones, (B + 1,)."""
        return self._named().offsets

    @property
    def ids(self) -> Ints:
        """Ids (P,) of the objects of hits and contacts, pose after pose, ascending for each.

        Raises `UsageError` for a batch without objects.
        """
        return self._named().ids

    def ids_at(self, pose: int) -> list[int]:
        """Ids of the objects in contact at one pose, ascending."""
        named = self._named()
        pose = range(len(self))[pose]  # raises IndexError; a negative one counts from the end
        found: list[int] = named.ids[named.offsets[pose] : named.offsets[pose + 1]].tolist()
        return found

    @property
    def objects(self) -> list[Object]:
        """Objects in contact at any pose, ordered by id."""
        named = self._named()
        return [named.known[i] for i in np.unique(named.ids).tolist()]

    def _named(self) -> TouchedIds:
        if self.named is None:
            raise UsageError("this batch was felt without objects: ask for it with objects=True")
        return self.named


class ClearanceBatch(Tabular):
    """Distances of a tool's points from the environment at B poses, at one committed revision.

    distances (B,) float64 : metres from the nearest of the shell's points to the nearest occupied
        voxel's box: 0 for a pose with a hit, infinite with nothing within reach, never more than to
        a surface. If exact: from the tool's surface to the nearest surface of an object.
    points (B,) int64 : index of a nearest point, -1 with nothing within reach
    reach : greatest distance of the search, metres
    revision : revision of the environment
    """

    def __init__(self, n_poses: int, reach: float) -> None:
        self.distances: Floats = np.full(n_poses, np.inf)
        self.points: Ints = np.full(n_poses, -1, dtype=np.int64)
        self.reach = reach
        self.revision = 0

    def __len__(self) -> int:
        return len(self.distances)

    def __repr__(self) -> str:
        least = f"least {self.distances.min():.4g} m, " if len(self) else ""
        reach = f"within {self.reach:.4g} m" if np.isfinite(self.reach) else "there"
        n_beyond = np.count_nonzero(self.is_beyond)
        return (
            f"ClearanceBatch({len(self)} poses, {n_beyond} with nothing {reach}, {least}"
            f"revision {self.revision})"
        )

    def columns(self) -> Columns:
        """A row for each pose, with the index of the tool's nearest point."""
        return {
            "pose": np.arange(len(self)),
            "distance_m": self.distances,
            "point": self.points,
            "revision": np.full(len(self), self.revision),
        }

    @property
    def is_beyond(self) -> NDArray[np.bool_]:
        """Whether nothing is within reach of each pose, (B,)."""
        return np.asarray(self.points < 0)
