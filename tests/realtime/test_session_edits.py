"""A running session feels edits of the environment, on both engines."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.kernels.large.budget import Asleep
from hapticdb.kernels.records import MOST_MISSED, SERVO
from hapticdb.kernels.resident import cells as resident
from hapticdb.kernels.resident.cell_table import publish
from hapticdb.query.law import PLANE, SMOOTH
from hapticdb.realtime.coupling import Coupling
from hapticdb.realtime.drive import DirectDrive, SmoothDrive
from hapticdb.realtime.session import Session
from hapticdb.recording.frame import State
from hapticdb.resident.held import held_tool
from hapticdb.resident.table import CellTable
from hapticdb.store.base import NO_KEYS
from hapticdb.testing import floor_voxels
from realtime.hands import stroking
from realtime.sessions import NEVER_STALE, RATE, felt_at, floored, recorded, until
from realtime.worlds import SIZE, make, move
from servers import Place


def test_edits_are_felt_and_no_frame_mixes_two_revisions(
    sphere: PointShell, tmp_path: Path
) -> None:
    """The floor moves 6 mm down under a hand that presses 2 mm into it, and returns."""
    with floored(make(tmp_path, bits=6)) as env:
        check_edits(env, sphere, tmp_path / "edited.hdbrec")


@pytest.mark.long
def test_edits_on_a_server_are_felt_and_no_frame_mixes_two_revisions(
    place: Place, sphere: PointShell, tmp_path: Path
) -> None:
    grid = Grid(SIZE, (-32 * SIZE,) * 3, 6)
    with floored(hapticdb.create(place(), grid, layout="brick")) as env:
        check_edits(env, sphere, tmp_path / "edited.hdbrec")


@dataclass
class Scene:
    """What a drive reads, of a table without cells."""

    cells: resident.Cells
    row: int
    clusters: resident.Clusters
    asleep: Asleep
    servo: NDArray[np.void]
    pose: NDArray[np.float64]
    missed: NDArray[np.int64]
    place: resident.Place


@pytest.mark.parametrize("is_smooth", [False, True])
def test_a_frame_is_noted_with_the_revision_of_the_cells_that_it_read(
    sphere: PointShell, monkeypatch: pytest.MonkeyPatch, *, is_smooth: bool
) -> None:
    """Others write just before its kernel begins, and again as soon as it has ended."""
    law = SMOOTH if is_smooth else PLANE
    with CellTable.create(8 << 20, distances=is_smooth) as table, table.reading() as row:
        control, servo = table.cells.control, np.zeros((), SERVO)
        servo["hand"]["quaternion"][0] = 1.0
        place = resident.Place(0.0, 0.0, 0.0, 0.01, 64.0)
        missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        tool = held_tool(sphere, 0.01)
        scene = Scene(table.cells, row, *tool, servo, np.eye(4), missed, place)
        drive: DirectDrive | SmoothDrive
        if is_smooth:
            spring = Coupling().settled(SCRIPTED, 500.0, 1.0, 0.024).spring()
            drive = SmoothDrive(scene, spring, law)
        else:
            drive = DirectDrive(scene, Coupling().direct(SCRIPTED, 1.0, 0.024).terms(), 0.024, law)
        frame = drive._frame

        def edited(*arguments: NDArray[np.float64]) -> int:
            publish(control, 2, 8, NO_KEYS)
            left_out = frame(*arguments)  # type: ignore[arg-type]
            publish(control, 3, 9, NO_KEYS)
            return left_out

        publish(control, 1, 7, NO_KEYS)
        monkeypatch.setattr(drive, "_frame", edited)
        if is_smooth:
            drive.feel()
        else:
            drive.step(1e-3)
        assert servo["sent"]["revision"] == 8


def check_edits(edited: Environment, sphere: PointShell, path: Path) -> None:
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
    for ijk, these in ((down, revisions[1::2]), (up, revisions[::2])):
        move(edited.store, 1, ijk)
        mine = frames[np.isin(frames["revision"], these)]
        np.testing.assert_array_equal(felt_at(edited, sphere, mine, PLANE), mine["wrench"])
        assert mine["wrench"].any() == (ijk is up)


def last_revision(session: Session) -> int:
    last = session.last()
    return -1 if last is None else int(last["revision"][0])
