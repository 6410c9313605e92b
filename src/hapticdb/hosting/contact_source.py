"""ContactSource: the tool of one remote hand, and the contact proxies that it gets.

The tool follows the hand by the quasi-static coupling, as in a session, but only when a proxy is
wanted: in a few steps along the way from the last hand to the newest one. The thread that asks for
a proxy computes it, without the interpreter lock.
"""

import math
import threading
import time

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.profiles import SCRIPTED
from hapticdb.errors import UsageError
from hapticdb.kernels.field.law import ONSET
from hapticdb.kernels.hand import quasistatic
from hapticdb.kernels.hand.device_spring import DeviceSpring, contact_stiffness
from hapticdb.kernels.hand.holding import IS_HELD
from hapticdb.kernels.proxy.linearize import linearize
from hapticdb.kernels.proxy.planes import ROW_COLUMNS
from hapticdb.kernels.records import CONTACT_MODEL
from hapticdb.pointshell.shell import PointShell
from hapticdb.protocol.contacts import (
    FINE,
    IS_LOOSE,
    IS_WAITING,
    PLANE,
    UNIT,
    HandState,
    ProxyState,
    ProxyTerms,
    ProxyWish,
)
from hapticdb.query.law import SMOOTH
from hapticdb.ready import make_ready
from hapticdb.realtime.coupling import Coupling, radius_of
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.stations import Station, Stations
from hapticdb.resident.held import held_tool

Floats = NDArray[np.float64]

RATE = 100.0
"""Proxies a second. Larger: the planes are newer, and the server and the network do more."""
STEP, LONGEST = 1e-3, 0.1
"""Seconds of the coupling for one proxy: at least, and at most. Larger: a hand that was silent for
long is followed as if it had moved more slowly."""
STEP_WAY = 0.2
"""Way of the tool's farthest point, voxels, that one step of the coupling follows. Larger: fewer
steps, and a hand that turns back is followed less exactly."""
MOST_STEPS = 10
"""Most steps of the coupling for one proxy. Larger: fast hands are followed more exactly, and a
proxy takes longer."""


class ContactSource:
    """A tool in resident cells that follows a remote hand.

    The source is a reader of the cells until it is closed.

    Raises
    ------
    UsageError
        If the cells have no distances, or a number of the wish is out of its range.
    """

    def __init__(self, cells: ResidentCells, shell: PointShell, wish: ProxyWish) -> None:
        if not cells.has_distances:
            raise UsageError(
                "contact proxies need distances to surfaces, which this environment lacks: import "
                "it again with --distances"
            )
        make_ready("proxies")
        size = cells.grid.voxel_size
        radius = radius_of(shell, size)
        coupling = Coupling(
            stiffness=wish.stiffness or None,
            turn_stiffness=wish.turn_stiffness or None,
            cap=wish.cap or None,
            torque_cap=wish.turn_cap or None,
        ).settled(SCRIPTED, 1.0 / STEP, 1.0, radius)
        self._spring: DeviceSpring = coupling.spring()._replace(
            damping=0.0
        )  # the client damps at its own rate
        self._cells = cells
        self._row = cells.table.join()
        self._stations = Stations(SMOOTH)
        self._station = Station(
            self._stations.rows, cells.table.cells, self._row,
            cells.table.desk.sessions[self._row, ...], cells.grid, held_tool(shell, size),
        )  # fmt: skip
        self._station.set_spring(self._spring)
        self._station.row["is_running"] = True
        self._rows = np.zeros((len(shell), ROW_COLUMNS))
        self.model: NDArray[np.void] = np.zeros((), CONTACT_MODEL)
        """Record of `CONTACT_MODEL`: the last proxy before it was rounded for its message."""
        self.terms = ProxyTerms(
            wish.tool, (float(shell.center[0]), float(shell.center[1]), float(shell.center[2])),
            radius, self._spring.stiffness, self._spring.turn_stiffness, self._spring.cap,
            self._spring.turn_cap, float(contact_stiffness(self._spring, size)), size,
            ONSET * size, 1.0 / RATE,
        )  # fmt: skip
        self._computing = threading.Lock()
        self._last: Floats | None = None  # the hand that the tool has followed
        self._clock = 0.0  # of that hand, s
        self.n_sent = 0
        """Proxies computed so far."""

    @property
    def share(self) -> float:
        """Share of the stiffness that the guard against shaking leaves; 1 where nothing shakes."""
        return float(self._station.follower["share"])

    def close(self) -> None:
        """Stop being a reader of the cells; a second call does nothing."""
        with self._computing:
            row, self._row = self._row, -1
            if row >= 0 and not self._cells.is_closed:
                self._cells.table.leave(row)

    def proxy(self, hand: HandState, kept: float = 0.0) -> ProxyState:
        """Follow the newest hand, come `kept` seconds ago, and describe the contacts there.

        An open hand is let go.
        """
        with self._computing:
            return self._proxy(hand, kept)

    def _proxy(self, hand: HandState, kept: float) -> ProxyState:
        if self._row < 0 or self._cells.is_closed:
            raise UsageError("the source of contacts is closed: make another")
        start = time.monotonic()
        at = np.concatenate([hand.position, hand.quaternion])
        if hand.is_open or self._last is None:
            self._begin(at)
        self._follow(at, hand)
        one = self._station
        linearize(
            one.cells, one.reader, one.clusters, one.place, self._spring, one.servo, one.follower,
            one.field, self._rows, self.model,
        )  # fmt: skip
        self.n_sent += 1
        return self._state(hand, kept + time.monotonic() - start)

    def _begin(self, at: Floats) -> None:
        """Put the tool where the hand is, at rest."""
        self._station.rest_at(at)
        self._last = at

    def _follow(self, at: Floats, newest: HandState) -> None:
        """Move the tool after the hand, from the last hand to the newest one, at (7,).

        The time that the hand took is the coupling's: its guard counts how often a force turns back
        in a time, and would take a way in quick steps for shaking.
        """
        last = self._last
        assert last is not None  # noqa: S101 - `_begin` has set it
        turned = at[3:] if float(last[3:] @ at[3:]) >= 0.0 else -at[3:]
        angle = 2.0 * float(np.linalg.norm(turned - last[3:]))
        way = float(np.linalg.norm(at[:3] - last[:3])) + self._spring.radius * angle
        steps = min(max(math.ceil(way / (STEP_WAY * self._station.place.size)), 1), MOST_STEPS)
        period = min(max(newest.clock - self._clock, STEP), LONGEST) / steps
        self._clock = newest.clock
        hand = self._station.servo["hand"]
        hand["velocity"][:3] = newest.velocity[:3]
        for step in range(1, steps + 1):
            share = step / steps
            quaternion = last[3:] + share * (turned - last[3:])
            hand["position"] = last[:3] + share * (at[:3] - last[:3])
            hand["quaternion"] = quaternion / np.linalg.norm(quaternion)
            self._stations.step(period, time.monotonic_ns())
        self._last = at.copy()

    def _state(self, hand: HandState, kept: float) -> ProxyState:
        """Round the model for its message."""
        model, n = self.model, int(self.model["n_planes"])
        sent = self._station.servo["sent"]
        flags = IS_WAITING if int(sent["marks"]) & IS_HELD else 0
        flags |= IS_LOOSE if int(sent["marks"]) & quasistatic.IS_LOOSE else 0
        return ProxyState(
            self.n_sent, int(sent["revision"]), hand.sequence, hand.clock, kept, time.monotonic(),
            flags, float(model["trust"]), hand.position, hand.quaternion,
            model["tool"][:3] - model["hand"][:3], model["tool"][3:].copy(),
            model["wrench"].copy(), model["stiffness"].copy(), float(model["spring"]),
            float(model["turn_spring"]),
            _rounded_planes(model, n, self._spring.radius, self._station.place.size),
        )  # fmt: skip


def _rounded_planes(
    model: NDArray[np.void], count: int, radius: float, size: float
) -> NDArray[np.void]:
    """Planes (count,) of `PLANE` of a model; its lengths in radii and voxels, m."""
    planes = np.zeros(count, PLANE)
    planes["lever"] = _rounded(model["levers"][:count] / radius, 1.0 / UNIT)
    planes["normal"] = _rounded(model["normals"][:count], 1.0 / UNIT)
    planes["depth"] = _rounded(model["depths"][:count] / size, FINE)
    planes["weight"] = np.clip(np.rint(model["weights"][:count]), 1, 65535)
    planes["bends"] = _rounded(model["bends"][:count] * size, FINE)
    planes["along"] = np.rint(127.0 * model["along"][:count])
    return planes


def _rounded(values: Floats, step: float) -> NDArray[np.int16]:
    """Values in steps, as 16 bits; larger ones are cut."""
    return np.asarray(np.clip(np.rint(values / step), -32767, 32767), dtype=np.int16)
