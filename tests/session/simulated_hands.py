"""Hands whose looks are on numba's simulator of a GPU, which `test_on_gpu` runs in a process."""

import sys
import tempfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

import closed_forms
from banded import write_points
from children import TIMEOUT
from closed_forms import UPRIGHT, Field, Hand, field_of, hole, moved, plane, punch, sheet
from hapticdb import PointShell
from hapticdb.devices.scripted import Player
from hapticdb.kernels.gpu import proximity_queries as kernels
from hapticdb.kernels.resident.cells import UNKNOWN, key_of_cell
from hapticdb.recording.file import Recording
from hapticdb.resident.table import CellTable
from hapticdb.session import gpu_queries
from hapticdb.session.replay import replay
from hapticdb.session.session import Session
from session.hands import at
from session.sessions import NEVER_STALE, floor_points
from session.worlds import make

Floats = NDArray[np.float64]
SIZE = 0.005
RUN = 8
kernels.THREADS_OF_RUNS, kernels.THREADS, kernels.MOST_BLOCKS = 2, 2, 3
gpu_queries.ROOM = 4, 1 << 30
sys.setswitchinterval(1e-4)  # the simulator watches its threads without a pause


class Pair:
    """One hand on the processor, one whose looks are on the GPU, in the same cells."""

    def __init__(
        self,
        field: Field,
        points: Floats,
        place: ArrayLike,
        turned: ArrayLike = UPRIGHT,
        **more: int,
    ) -> None:
        self.cells, self.hands = field.cells, [Hand(field, points, place, turned) for _ in range(2)]
        for hand in self.hands:
            hand.near.view(np.float64)[:] = 0.0
            for name, number in more.items():
                hand.follower[name] = number
        cells, n_slots = field.cells, len(field.cells.used)
        self.table = SimpleNamespace(
            cells=cells, n_slots=n_slots, capacity=cells.keys.shape[1], size_bytes=0,
            version=0, filled=np.ones(n_slots, dtype=np.int64),
        )  # fmt: skip
        self.gpu = gpu_queries.GpuQueries(self.hands[1]._state, cast("CellTable", self.table))
        self.n_bent = 0

    def move(self, position: ArrayLike) -> None:
        """Move both, and compare all that they find."""
        ours, theirs = self.hands
        for hand in self.hands:
            hand.move(position)
            self.gpu.check()
        assert ours.state.tobytes() == theirs.state.tobytes()
        assert ours.servo["sent"].tobytes() == theirs.servo["sent"].tobytes()
        near = [
            (hand.follower["n_near"], hand.follower["side"], hand.follower["merged"])
            for hand in self.hands
        ]
        assert near[0] == near[1]
        n_near, side = int(near[0][0]), int(near[0][1])
        found, wanted = (hand.near[side, :n_near] for hand in self.hands)
        assert (found == wanted).all()
        found, wanted = (hand.bends[side, :n_near][found["is_hollow"]] for hand in self.hands)
        assert (found == wanted).all()
        self.n_bent += len(found)


def a_flat_tool_is_pressed_on_a_plane_and_leaves() -> None:
    low = 1.5 * SIZE
    for more in ({}, {"is_large": 1, "merges_from": 12}):
        pair = Pair(
            field_of(plane([0.0, 0.0, 1.0]), SIZE), punch(5, 0.004), [0.0, 0.0, low + 0.03], **more
        )
        for height in (0.03, 0.01, 0.001, -0.002, -0.003):
            pair.move([0.0, 0.0, low + height])
        assert pair.hands[1].sent.contacts > 0
        assert (pair.hands[1].follower["merged"] > 1) == ("merges_from" in more)
        for height in (-0.003, 0.02, 0.04):
            pair.move([0.002, 0.0, low + height])
        assert not pair.hands[1].sent.contacts


def no_point_passes_a_sheet() -> None:
    """Looks that end early are put back: the way is that of the processor."""
    start = np.array([0.0, 0.0, 0.04])
    pair = Pair(
        field_of(sheet([0.0, 0.0, 1.0]), SIZE), punch(5, 0.006), start, (0.995, 0.0995, 0.0, 0.0),
        merges_from=6, is_large=1,
    )  # fmt: skip
    for n in range(8):
        pair.move(start - [0.0, 0.0, 0.02 * n])
        assert pair.hands[1].placed[:, 2].min() > 0.0
    assert pair.hands[1].sent.wrench.any()


def a_hollow_surface_is_felt_and_a_tool_may_begin_in_something() -> None:
    points = punch(5, 0.006) @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    for start in (0.0, 0.02):
        pair = Pair(field_of(hole(0.02), SIZE), points, [start, 0.0, 0.0])
        for n in range(5):
            pair.move([start + 0.004 * n, 0.001 * n, 0.0])
        assert pair.hands[1].follower["is_loose"] or pair.n_bent


def unknown_is_never_empty_and_what_changes_is_felt() -> None:
    """A cell is taken out of the directory, and comes back in a version with a raised floor."""
    field, place = field_of(plane([0.0, 0.0, 1.0]), SIZE), [0.0, 0.0, 2.5 * SIZE]
    pair, cells = Pair(field, punch(3, 0.06), place), field.cells
    pair.move(place)
    assert not pair.hands[1].sent.wrench.any()
    which = np.flatnonzero(cells.keys[1] == key_of_cell(1, 1, 1))[0]
    cells.slots[1, which] = UNKNOWN
    cells.control["version"] = 4
    pair.move(place)
    for hand in pair.hands:
        assert hand.sent.unknown == 4
        assert hand.missed["n_cells"] == 1
        assert hand.missed["cells"][0] == cells.keys[1, which]
    raised = field_of(moved(plane([0.0, 0.0, 1.0]), [0.0, 0.0, 0.7 * SIZE]), SIZE).cells.payload
    assert cells.payload is not None
    assert raised is not None
    cells.payload[:] = raised
    pair.table.filled[:] = cells.control["version"] = 5
    for n in range(4):
        pair.move([0.0, 0.0, (2.5 - 0.3 * n) * SIZE])
    assert pair.hands[1].sent.unknown == 0
    assert pair.hands[1].sent.wrench[2] > 0.0
    assert cells.used.any()


class Pressing(Player):
    """A hand that comes down on the floor and leaves; to load it loads this module."""

    def __init__(self) -> None:
        places = [at(0.0, 0.0, z) for z in (0.01, -0.001, 0.01)]
        super().__init__(np.linspace(0.0, 3.0, 3), places)


def a_session_feels_says_where_and_is_replayed() -> None:
    with tempfile.TemporaryDirectory() as home, make(Path(home), bits=6) as env:
        write_points(env.store, floor_points(31.5), "floor")
        path = Path(home, "s.hdbrec")
        with Session(
            env.url, PointShell.sphere(0.004, 20), Pressing(), rate=20.0, frames_on="cuda",
            record=path, staleness=NEVER_STALE, has_baseline=False,
        ) as session:  # fmt: skip
            report = session.wait(TIMEOUT)
        assert report is not None
        assert report.contact_frames > 0
        assert report.peak_force > 0.0
        assert report.conditions["frames on"] == "simulated"
        replayed = replay(Recording(path), env)
        told = replayed.describe()
        assert replayed.is_equal or "computed on a GPU" in told, told


CHECKS = (
    a_flat_tool_is_pressed_on_a_plane_and_leaves,
    no_point_passes_a_sheet,
    a_hollow_surface_is_felt_and_a_tool_may_begin_in_something,
    unknown_is_never_empty_and_what_changes_is_felt,
    a_session_feels_says_where_and_is_replayed,
)


def main() -> None:
    """Run the checks."""
    closed_forms.tool_of = partial(closed_forms.tool_of, run=RUN)
    np.seterr(over="ignore")  # a hash in plain Python
    for check in CHECKS:
        check()
        print(check.__name__, flush=True)  # noqa: T201 - read by `test_on_gpu`
