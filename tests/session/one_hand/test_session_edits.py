"""A running session feels edits of the environment."""

from pathlib import Path

import numpy as np
import pytest

from hapticdb import Grid, PointShell
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.kernels.records.hand import FRAME
from hapticdb.kernels.records.session import SLOT
from hapticdb.kernels.resident.cell_table import publish
from hapticdb.query.law import DISTANCE, PLANE
from hapticdb.recording.frame import State
from hapticdb.resident.point_runs import clusters_of
from hapticdb.resident.table import CellTable
from hapticdb.session.coupling import Coupling
from hapticdb.session.session import Session
from hapticdb.session.states import PeriodClock, SessionState
from session.hands import stroking
from session.sessions import NEVER_STALE, RATE, felt_at, floored, recorded, until
from session.worlds import make, move
from voxels import floor_voxels


@pytest.mark.parametrize("reads_distances", [False, True])
def test_periods_revision_of_cells_read(sphere: PointShell, *, reads_distances: bool) -> None:
    """Others write just before its kernel begins, and again as soon as it has ended."""
    grid, slots, rings = Grid(0.01, (0.0, 0.0, 0.0), 6), np.zeros(1, SLOT), np.zeros((1, 4), FRAME)
    with CellTable.create(8 << 20, distances=reads_distances) as table, table.reading() as row:
        periods = PeriodClock(DISTANCE if reads_distances else PLANE, slots, rings)
        cells = table.cells if reads_distances else table.cells.without_distances()
        state = SessionState(
            slots[0, ...],
            cells,
            row,
            table.queue.requests[row, ...],
            grid,
            clusters_of(sphere, 0.01),
        )
        state.set_spring(Coupling().direct(SCRIPTED, 1.0, 0.024).spring())
        state.servo["hand"]["quaternion"][0] = state.servo["tool"]["quaternion"][0] = 1.0
        state.slot["is_frame"] = True
        periods.enter(state)
        for revision in (7, 8, 9):
            publish(table.cells.control, revision - 6, revision)
            periods.step(1e-3, 0)
        assert rings["revision"][0].tolist() == [7, 8, 9, 0]


def test_session_edits_no_mixed_revisions(sphere: PointShell, tmp_path: Path) -> None:
    """The floor moves 6 mm down under a hand that presses 2 mm into it, and returns."""
    edited, path = floored(make(tmp_path, bits=6)), tmp_path / "edited.hdbrec"
    up = floor_voxels(edited.grid, width=48)
    down = up - np.array([0, 0, 3])
    with Session(
        edited.url, sphere, stroking(0.010, 0.4, loops=True), law="plane", rate=RATE, record=path,
        staleness=NEVER_STALE,
    ) as session:  # fmt: skip
        for ijk in (down, up, down):
            n_frames = session.n_frames
            until(lambda n=n_frames: session.n_frames > n + 250, session)  # type: ignore[misc]
            move(edited.store, 1, ijk)
            revision = edited.store.revision()
            until(lambda r=revision: last_revision(session) == r, session)  # type: ignore[misc]
        session.wait(0.3)
        session.stop()
    frames = recorded(path)
    frames = frames[frames["state"] & State.HELD == 0]
    revisions = np.unique(frames["revision"]).tolist()
    assert revisions == [revision - 3, revision - 2, revision - 1, revision]
    assert (np.diff(frames["revision"]) >= 0).all()
    frames = frames[frames["time"] > 0.1]  # the force has risen
    for ijk, these in ((down, revisions[1::2]), (up, revisions[::2])):
        move(edited.store, 1, ijk)
        mine = frames[np.isin(frames["revision"], these)]
        forces = felt_at(edited, sphere, mine, PLANE)[:, :3]
        np.testing.assert_array_equal(forces, mine["applied"][:, :3])
        assert forces.any() == (ijk is up)


def last_revision(session: Session) -> int:
    last = session.last()
    return -1 if last is None else int(last["revision"][0])
