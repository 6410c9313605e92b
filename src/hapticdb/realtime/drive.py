"""Drives: what moves the tool in each period of the loop, with a coupling or without.

A drive has the state that is kept beside the servo record, and calls the kernels. The loop treats
both alike.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.hand import direct, quasistatic
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.hand.near_points import (
    FELT_POINTS,
    FIELD_ROWS,
    FLOOR,
    MET_ROWS,
    NEAR,
    NEAR_POINTS,
    NEAR_ROWS,
    U,
)
from hapticdb.kernels.large.budget import Asleep, feel_kernel
from hapticdb.kernels.large.sleeping import LEFT_OUT
from hapticdb.kernels.records import FOLLOWER, MOST_MISSED, RESULTS, pose_numbers
from hapticdb.kernels.resident.cells import (
    FELT_REVISION,
    READER_STRIDE,
    UNKNOWNS,
    Cells,
    Clusters,
    Place,
)
from hapticdb.kernels.rigid import poses_of
from hapticdb.query.law import ForceLaw

MERGES_FROM = 4096
"""Near points of the quasi-static coupling from which one contact stands for several. Larger:
broader contacts are felt point by point, and a period with them takes longer."""
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Record = NDArray[np.void]


def prepare_follower(follower: Record, n_points: int, asleep: Asleep) -> None:
    """Let the quasi-static coupling of a tool merge broad contacts, and keep to its budget."""
    follower["merges_from"] = MERGES_FROM
    if len(asleep.sleepers.boxes):
        follower["is_large"] = True
        follower["most_looked"] = asleep.budget if asleep.budget < n_points else 0


class _DriveInputs(Protocol):
    """What a drive reads: the loop has these."""

    cells: Cells
    row: int
    place: Place
    clusters: Clusters
    servo: Record
    missed: NDArray[np.int64]
    pose: Floats
    asleep: Asleep
    """What of the tool sleeps, and its budget of points."""


class _Drive:
    """Frames of the law at one pose, and the tool's state, with a copy of it to step back to.

    Attributes
    ----------
    radius : float
        Distance of the tool's farthest point from its centre, m.
    """

    def __init__(self, scene: _DriveInputs, cells: Cells, law: ForceLaw, radius: float) -> None:
        self.radius = radius
        self._scene, self._cells, self._law = scene, cells, law.for_kernels
        self._hits = np.empty(len(scene.clusters.points), dtype=np.int64)
        self._tool, self._sent = scene.servo["tool"], scene.servo["sent"]
        self._tool_before = self._tool.copy()
        self._left_out = self._sent["left_out"]
        at = scene.row * READER_STRIDE + FELT_REVISION
        self._revision = scene.cells.readers[at : at + 1]

    def _frame(self, poses: Floats, missed: Indices, out: Floats) -> int:
        """Compute the frame at poses (1, 4, 4) into out (1, RESULTS), unless the pose is NaN.

        `_hits` takes the indices of the hits, `missed` the unknown cells. Returns how many points
        the budget left out.
        """
        scene = self._scene
        counts = scene.asleep.counts
        counts[:] = 0
        feel_kernel(
            self._cells, scene.row, scene.clusters, poses, scene.place, self._law, self._hits,
            missed, out, scene.asleep,
        )  # fmt: skip
        return int(counts[0, LEFT_OUT])

    def remember(self) -> None:
        """Store the state, so that `step_back` can return to it."""
        self._tool_before[()] = self._tool

    def step_back(self, *, from_zero: bool) -> None:
        """Return to the remembered state; `from_zero`: the force rises again from zero."""
        self._tool[()] = self._tool_before  # a coupling's own state stays, as its kernel asks
        if from_zero:
            self._tool["risen"] = 0.0


class DirectDrive(_Drive):
    """The tool at the hand: the wrench of each frame goes to the device, up to its caps.

    Parameters
    ----------
    scene : _DriveInputs
        Cells, tool and servo record.
    terms : DirectTerms
        What bounds the wrench.
    radius : float
        Distance of the tool's farthest point from its centre, m.
    law : ForceLaw
        Law of the wrench; it reads no distances.
    """

    def __init__(
        self, scene: _DriveInputs, terms: direct.DirectTerms, radius: float, law: ForceLaw
    ) -> None:
        super().__init__(scene, scene.cells.without_distances(), law, radius)
        self._terms = terms
        self._hand_pose, self._at_hand = pose_numbers(scene.servo["hand"])[None], np.eye(4)[None]
        self._felt = np.zeros((1, RESULTS))

    @property
    def least_share(self) -> float:
        """Share of the stiffness that is left: there is no guard."""
        return 1.0

    def step(self, dt: float) -> None:
        """Feel the scene at the hand, a period `dt` (s) later; `sent` then has the wrench."""
        scene = self._scene
        poses_of(self._hand_pose, self._at_hand)
        left_out = self._frame(self._at_hand, scene.missed, self._felt)
        revision = self._revision.item()
        direct.render(self._terms, scene.clusters.center, scene.servo, self._felt, revision, dt)
        self._left_out[()] = left_out

    def touching(self, n_hits: int) -> Indices:
        """Indices of the last frame's hits, as many as it had."""
        return self._hits[:n_hits]

    def feel(self) -> None:
        """Nothing to do: each step is a frame of the law at the tool's pose."""


class SmoothDrive(_Drive):
    """The quasi-static tool of `Coupling`, over distances to surfaces.

    Parameters
    ----------
    scene : _DriveInputs
        Cells, tool and servo record; the cells have distances.
    spring : DeviceSpring
        The spring between hand and tool.
    law : ForceLaw
        Law of the wrench that is recorded, which a replay computes again. The coupling itself has
        contacts of its own stiffness.
    """

    def __init__(self, scene: _DriveInputs, spring: DeviceSpring, law: ForceLaw) -> None:
        super().__init__(scene, scene.cells, law, spring.radius)
        self._spring = spring
        n_points = len(scene.clusters.points)
        self._follower = np.zeros((), FOLLOWER)
        self._field = np.zeros((FIELD_ROWS, n_points))
        self._near_points = np.zeros((MET_ROWS, n_points), dtype=np.int64)
        self._missed_here = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        self._felt_here = np.zeros((1, RESULTS))
        self._felt, self._unknown = self._tool["felt"], self._sent["unknown"]
        prepare_follower(self._follower, n_points, scene.asleep)

    def step(self, dt: float) -> None:
        """Advance the tool by a period `dt` (s); `sent` then has the wrench for the device."""
        scene = self._scene
        quasistatic.advance(
            scene.cells, scene.row, scene.clusters, scene.place, self._spring, scene.servo,
            self._follower, dt, self._field, self._near_points, scene.missed,
        )  # fmt: skip

    @property
    def least_share(self) -> float:
        """Share of the stiffness that the guard has left, 1 where it has not acted."""
        return float(self._follower["wanted_share"]) or 1.0

    def touching(self, n_hits: int) -> Indices:
        """Indices of the points that touch, `n_hits`; where it lies in something, those that do.

        The voxels of these points may be free: the fetching process looks around them.
        """
        if not self._follower["is_loose"]:
            return self._near_points[FELT_POINTS, :n_hits]
        side, n_near = int(self._follower["side"]), int(self._follower["n_near"])
        distances = self._field[NEAR + side * NEAR_ROWS + U, :n_near]
        return self._near_points[NEAR_POINTS + side, :n_near][distances < FLOOR]

    def feel(self) -> None:
        """Compute the law's frame at the tool's pose for the recording, after `step`.

        `tool.felt` takes its result, and `sent.revision` its revision: cells may have changed since
        the step. If cells were evicted since the step, points may be unknown
        by now: `sent.unknown` counts them, and a replay leaves the frame out.
        """
        felt = self._felt_here[0]
        left_out = self._frame(self._scene.pose[None], self._missed_here, self._felt_here)
        self._left_out[()] = max(self._left_out, left_out)
        self._felt[:] = felt
        self._sent["revision"] = self._revision.item()
        self._unknown += np.int64(felt[UNKNOWNS])
