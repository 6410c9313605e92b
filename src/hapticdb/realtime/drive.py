"""Drives: what moves the tool in each period of the loop, one for each coupling.

A drive has the state that a coupling keeps beside the servo record, and calls its kernel. The loop
treats both alike.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.hand import coupling as plane_kernels
from hapticdb.kernels.hand import large, quasistatic
from hapticdb.kernels.hand.anchors import BEFORE, MET_ROWS
from hapticdb.kernels.hand.body import Body
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.hand.near_points import (
    FIELD_ROWS,
    FLOOR,
    NEAR,
    NEAR_POINTS,
    NEAR_ROWS,
    U,
)
from hapticdb.kernels.large import budget
from hapticdb.kernels.large.sleeping import LEFT_OUT, Sleepers
from hapticdb.kernels.records import FOLLOWER, MOST_MISSED, RESULTS
from hapticdb.kernels.resident import feeling
from hapticdb.kernels.resident.cells import UNKNOWNS, Cells, Clusters, Place
from hapticdb.query.law import ForceLaw
from hapticdb.resident.sleepers import counts_of

MERGES_FROM = 4096
"""Near points of the quasi-static coupling from which one contact stands for several. Larger:
broader contacts are felt point by point, and a period with them takes longer."""
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Record = NDArray[np.void]


def prepare_follower(follower: Record, n_points: int, budget: int | None) -> None:
    """Let the quasi-static coupling of a tool merge broad contacts.

    budget : most points that a look takes, of a tool whose clusters sleep; None for other tools.
    """
    follower["merges_from"] = MERGES_FROM
    if budget is not None:
        follower["is_large"] = True
        follower["most_looked"] = budget if budget < n_points else 0


class DriveInputs(Protocol):
    """What a drive reads: the loop has these."""

    cells: Cells
    row: int
    place: Place
    clusters: Clusters
    servo: Record
    missed: NDArray[np.int64]
    pose: Floats
    sleepers: Sleepers | None
    """Of a large tool, or one with a budget of points; None: every run is tested in each frame."""
    budget: int
    """Most points near something that a frame looks at."""


class PlaneDrive:
    """The body of `Coupling`, pushed by the tangent-plane law.

    Parameters
    ----------
    scene : DriveInputs
        Cells, tool and servo record.
    body : Body
        The tool as a body.
    scale : float
        S: the torque at the device is the scene's over S.
    """

    def __init__(self, scene: DriveInputs, body: Body, scale: float) -> None:
        self._scene, self._body, self._scale = scene, body, scale
        self._cells = scene.cells.without_distances()  # distances, if any, are not read
        self.radius, self.hold = body.radius, body.hold
        self.least_share = 1.0
        self._met = np.empty((MET_ROWS, len(scene.clusters.points)), dtype=np.int64)
        self._met_before = self._met.copy()
        self._tool = scene.servo["tool"]
        self._tool_before = self._tool.copy()
        self._torque = scene.servo["sent"]["wrench"][3:]
        self._counts = counts_of(1)

    def step(self, dt: float) -> None:
        """Advance the tool by a period `dt` (s); `sent` then has the wrench for the device."""
        scene = self._scene
        if scene.sleepers is None:
            plane_kernels.advance(
                self._cells, scene.row, scene.clusters, scene.place, self._body, scene.servo, dt,
                self._met, scene.missed,
            )  # fmt: skip
        else:
            large.advance_asleep(
                self._cells, scene.row, scene.clusters, scene.place, self._body, scene.servo, dt,
                self._met, scene.missed, scene.sleepers, scene.budget, self._counts,
            )  # fmt: skip
        if self._scale != 1.0:
            self._torque /= self._scale

    def remember(self) -> None:
        """Store the state, so that `step_back` can return to it."""
        self._tool_before[()] = self._tool
        self._met_before[:] = self._met

    def step_back(self, *, from_zero: bool) -> None:
        """Return to the remembered state; `from_zero`: the force rises again from zero."""
        self._tool[()] = self._tool_before
        self._met[:] = self._met_before
        if from_zero:
            self._tool["risen"] = 0.0

    def touching(self, n_hits: int) -> Indices:
        """Indices of the last frame's hits, as many as it had."""
        return self._met[BEFORE, :n_hits]

    def feel(self) -> None:
        """Nothing to do: the frame at the tool's pose is computed in each step."""


class SmoothDrive:
    """The quasi-static tool of `DeviceCoupling`, over distances to surfaces.

    Parameters
    ----------
    scene : DriveInputs
        Cells, tool and servo record; the cells have distances.
    spring : DeviceSpring
        The spring between hand and tool.
    law : ForceLaw
        Law of the wrench that is recorded, which a replay computes again. The coupling itself has
        contacts of its own stiffness.
    """

    def __init__(self, scene: DriveInputs, spring: DeviceSpring, law: ForceLaw) -> None:
        self._scene, self._spring, self._law = scene, spring, law.for_kernels
        self.radius, self.hold = spring.radius, spring.hold
        n_points = len(scene.clusters.points)
        self._follower = np.zeros((), FOLLOWER)
        self._field = np.zeros((FIELD_ROWS, n_points))
        self._met = np.zeros((MET_ROWS, n_points), dtype=np.int64)
        self._tool = scene.servo["tool"]
        self._tool_before = self._tool.copy()
        self._met_here = np.empty(n_points, dtype=np.int64)
        self._missed_here = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        self._felt_here = np.zeros((1, RESULTS))
        self._felt, self._unknown = self._tool["felt"], scene.servo["sent"]["unknown"]
        self._left_out, self._counts = scene.servo["sent"]["left_out"], counts_of(1)
        is_awake = scene.sleepers is None
        prepare_follower(self._follower, n_points, None if is_awake else scene.budget)

    def step(self, dt: float) -> None:
        """Advance the tool by a period `dt` (s); `sent` then has the wrench for the device."""
        scene = self._scene
        quasistatic.advance(
            scene.cells, scene.row, scene.clusters, scene.place, self._spring, scene.servo,
            self._follower, dt, self._field, self._met, scene.missed,
        )  # fmt: skip

    @property
    def least_share(self) -> float:
        """Share of the stiffness that the guard has left, 1 where it has not acted."""
        return float(self._follower["wanted_share"]) or 1.0

    def remember(self) -> None:
        """Store the state, so that `step_back` can return to it."""
        self._tool_before[()] = self._tool

    def step_back(self, *, from_zero: bool) -> None:
        """Return to the remembered state; `from_zero`: the force rises again from zero."""
        self._tool[()] = self._tool_before  # the coupling's own state stays, as its kernel asks
        if from_zero:
            self._tool["risen"] = 0.0

    def touching(self, n_hits: int) -> Indices:
        """Indices of the points that touch, `n_hits`; where it lies in something, those that do.

        The voxels of these points may be free: the fetching process looks around them.
        """
        if not self._follower["is_loose"]:
            return self._met[BEFORE, :n_hits]
        side, n_near = int(self._follower["side"]), int(self._follower["n_near"])
        distances = self._field[NEAR + side * NEAR_ROWS + U, :n_near]
        return self._met[NEAR_POINTS + side, :n_near][distances < FLOOR]

    def feel(self) -> None:
        """Compute the law's frame at the tool's pose for the recording, after `step`.

        `tool.felt` takes its result. If cells were evicted since the step, points may be unknown
        by now: `sent.unknown` counts them, and a replay leaves the frame out.
        """
        scene, felt = self._scene, self._felt_here[0]
        if scene.sleepers is None:
            feeling.feel_kernel(
                scene.cells, scene.row, scene.clusters, scene.pose[None], scene.place, self._law,
                self._met_here, self._missed_here, self._felt_here,
            )  # fmt: skip
        else:
            self._counts[:] = 0
            budget.feel_within(
                scene.cells, scene.row, scene.clusters, scene.pose[None], scene.place, self._law,
                self._met_here, self._missed_here, self._felt_here, scene.sleepers, scene.budget,
                self._counts,
            )  # fmt: skip
            self._left_out[()] = max(self._left_out, self._counts[0, LEFT_OUT])
        self._felt[:] = felt
        self._unknown += np.int64(felt[UNKNOWNS])
