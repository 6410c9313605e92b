"""One session in a worker process: its hand, its tool, its frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hapticdb.grid import Grid
from hapticdb.hosting.board import BIN, BINS, MOST_CONTACTS, Board
from hapticdb.hosting.following import Following
from hapticdb.kernels.hand import coupling as kernels
from hapticdb.kernels.hand import quasistatic, servo
from hapticdb.kernels.records import MOST_MISSED, SERVO, TOLD, pose_numbers, views_of
from hapticdb.kernels.resident.cells import Place
from hapticdb.kernels.rigid import poses_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import ForceLaw
from hapticdb.realtime.coupling import Coupling, SettledCoupling
from hapticdb.realtime.drive import PlaneDrive, SmoothDrive
from hapticdb.recording.frame import State
from hapticdb.resident.frames import clusters_of
from hapticdb.resident.table import HEARTBEAT, CellTable

STALENESS_NS = 1_000_000_000
"""Nanoseconds without an answer of the database after which frames act as if all cells were
unknown."""
ASK_EVERY_NS, SHOW_EVERY_NS = 10_000_000, 30_000_000
"""Nanoseconds between two requests for the ids of what is touched, and between two lists of the
contacts. Larger: less computing, and what is shown is older."""


@dataclass(frozen=True)
class SeatRequest:
    """What a worker needs to run a session.

    seat : row of the board; table, n_slots : name and slots of the table of cells, whose descriptor
    comes beside; reader : the session's row there; pose (7,) : where hand and tool start.
    """

    seat: int
    table: int
    n_slots: int
    reader: int
    grid: Grid
    shell: PointShell
    law: ForceLaw
    coupling: Coupling | SettledCoupling
    scale: float
    pose: tuple[float, ...]

    def without_surface(self) -> "SeatRequest":
        """Return the same request without the tool's triangles, which no frame reads."""
        return replace(self, shell=replace(self.shell, surface=None))


class Seat:
    """A session that a worker runs, made beside the loop.

    Parameters
    ----------
    request : SeatRequest
        The session.
    board : Board
        The host's board.
    table : CellTable
        Its cells.
    """

    def __init__(self, request: SeatRequest, board: Board, table: CellTable) -> None:
        self.request, self._row = request, board.seats[request.seat : request.seat + 1]
        self.cells, self.row, grid = table.cells, request.reader, request.grid
        self.place = Place(*grid.origin, grid.voxel_size, float(grid.side))
        self.clusters = clusters_of(request.shell, grid.voxel_size)
        self.servo = np.zeros((), SERVO)
        self.tool, self.hand = self.servo["tool"], self.servo["hand"]
        pose_numbers(self.tool)[:] = pose_numbers(self.hand)[:] = request.pose
        self.sent = views_of(self.servo["sent"])
        self.missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        self.told = np.zeros((), TOLD)
        self.pose = np.eye(4)
        self._tool_pose, self._pose = pose_numbers(self.tool)[None], self.pose[None]
        self.drive = self._make_drive(request.coupling)
        self._session = table.desk.sessions[request.reader, ...]
        self._ring = board.rings[request.seat]
        self._following = Following(board.seats, request.seat, self.hand)
        self.began = 0
        self._asked_at = self._shown_at = 0

    def _make_drive(self, coupling: Coupling | SettledCoupling) -> PlaneDrive | SmoothDrive:
        request = self.request
        if isinstance(coupling, SettledCoupling):
            return SmoothDrive(self, coupling.spring(), request.law)
        body = coupling.body(request.shell, self.place, request.law.stiffness, request.scale)
        return PlaneDrive(self, body, request.scale)

    def set_coupling(self, coupling: Coupling | SettledCoupling) -> None:
        """Replace the coupling; the contacts are met anew."""
        drive = self._make_drive(coupling)
        self.tool["version"] = 0
        self.drive = drive

    def frame(self, begun: int, due: int, dt: float, clock: Callable[[], int]) -> None:
        """Run a frame that began at a time, ns, and was due at another; dt: s since the last."""
        row, sent = self._row, self.sent
        self._following.follow(begun)
        is_stale = begun - self.cells.control[HEARTBEAT] > STALENESS_NS
        self.hand["is_stale"] = is_stale
        self.drive.step(dt)
        flags = int(sent.flags)
        poses_of(self._tool_pose, self._pose)
        self._tell()
        if begun - self._asked_at >= ASK_EVERY_NS:
            self._asked_at = begun
            self._ask(flags)
        if begun - self._shown_at >= SHOW_EVERY_NS:
            self._shown_at = begun
            self._show()
        if row["is_recorded"][0] and not flags & kernels.IS_HELD:
            self.drive.feel()
        at = int(row["n_frames"][0])
        state = State.HELD * bool(flags & kernels.IS_HELD)
        state |= State.FADING * bool(flags & kernels.IS_FADING)
        state |= State.IN_OBJECT * bool(flags & quasistatic.IS_LOOSE)
        done = clock()
        servo.note(
            self._ring, at, (begun - self.began) * 1e-9, dt, (begun - due) * 1e-9,
            (done - begun) * 1e-9, self.servo, 0, int(state),
        )  # fmt: skip
        self._count(begun - due, done - begun, flags)
        row["stale_frames"] += is_stale
        row["n_frames"][0] = at + 1

    def _count(self, late: int, took: int, flags: int) -> None:
        row = self._row
        lateness, elapsed = late * 1e-9, took * 1e-9
        row["lateness"][0, min(int(lateness / BIN), BINS)] += 1
        row["elapsed"][0, min(int(elapsed / BIN), BINS)] += 1
        row["worst_lateness"][0] = max(row["worst_lateness"][0], lateness)
        row["worst_elapsed"][0] = max(row["worst_elapsed"][0], elapsed)
        row["unknown_frames"] += self.sent.unknown > 0
        row["held_frames"] += bool(flags & kernels.IS_HELD)

    def _tell(self) -> None:
        """Report where tool and hand are, and which cells the last frame missed."""
        told, center = self.told, self.request.shell.center
        told["is_active"] = True
        told["tool"] = self.pose[:3, :3] @ center + self.pose[:3, 3]
        told["handle"] = self.hand["position"] + self.pose[:3, :3] @ center
        if np.isnan(told["handle"][0]):  # nobody holds the tool: cells around it stay wanted
            told["handle"] = told["tool"]
        told["velocity"] = self.hand["velocity"][:3]
        told["radius"] = self.drive.radius
        servo.tell(self._session, told, self.missed)

    def _ask(self, flags: int) -> None:
        """Request the ids of what is touched, and copy those that have come."""
        is_touching = self.sent.hits or flags & quasistatic.IS_LOOSE
        n_hits = int(self.sent.hits)
        points = self.drive.touching(n_hits) if is_touching else np.empty(0, dtype=np.int64)
        grid = self.request.grid
        servo.name_voxels(
            self._session, self.clusters, self.pose, self.place, grid.bits, grid.curve_code,
            points, len(points),
        )  # fmt: skip
        n_objects = int(self._session["n_objects"])
        self._row["objects"][0, :n_objects] = self._session["objects"][:n_objects]
        self._row["n_objects"] = n_objects

    def _show(self) -> None:
        """List the contacts on the board."""
        points, forces = self.drive.contacts(int(self.sent.hits))
        step = -(-len(points) // MOST_CONTACTS) or 1
        placed = self.clusters.points[points[::step], :3] @ self.pose[:3, :3].T + self.pose[:3, 3]
        row, n_contacts = self._row, len(placed)
        row["contacts_sequence"] += 1
        row["contacts"][0, :n_contacts, :3] = placed
        row["contacts"][0, :n_contacts, 3:] = forces[::step]
        row["n_contacts"] = n_contacts
        row["contacts_sequence"] += 1

    def stop(self) -> None:
        """Tell the fetching process that the tool is gone."""
        self.told["is_active"] = False
        servo.tell(self._session, self.told, self.missed)
