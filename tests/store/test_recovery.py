"""A server that dies at any moment leaves a valid environment; the same command then finishes."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from assemblies import placement
from children import TIMEOUT
from crashes import (
    EDITS,
    N_PARTS,
    PLACE,
    After,
    Killer,
    crash,
    felt,
    moments,
    options,
    small,
    steps_of,
)
from hapticdb import Environment, PointShell
from hapticdb.ingest.files import ImportProgress
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.store.base import Layout
from hapticdb.store.postgres.tables.server_tables import ServerTables
from postgres_servers import Server
from servers import kill
from validity import Contents, assert_valid, contents, valid_contents


@pytest.mark.long
@pytest.mark.usefixtures("_impatient")
@pytest.mark.parametrize("layout", ["voxel", "brick"])
def test_import_files_repeated_after_server_crashes(
    server: Server, url: str, file: Path, undisturbed: dict[Layout, Contents], layout: Layout
) -> None:
    for n_parts, delay in moments(1):
        killer = Killer(n_parts, delay, lambda: kill(server))
        with pytest.raises(hapticdb.errors.ConnectionLostError) as told:
            hapticdb.import_files(url, [file], options(layout), killer)
        assert "\n" not in str(told.value)
        killer.joined()
        server.start()
        objects, _, _ = valid_contents(url)
        # all reported parts are stored: a commit waits for the disk
        assert n_parts <= len(objects) < N_PARTS
        assert objects == undisturbed[layout][0][: len(objects)]
    (report,) = hapticdb.import_files(url, [file], options(layout))
    assert (report.present, len(report.added)) == (len(objects), N_PARTS - len(objects))
    assert valid_contents(url) == undisturbed[layout]


@pytest.mark.long
@pytest.mark.parametrize("layout", ["voxel", "brick"])
def test_import_files_reconnects_after_crash(
    server: Server, url: str, file: Path, undisturbed: dict[Layout, Contents], layout: Layout
) -> None:
    crashes = [Killer(n, delay, lambda: crash(server)) for n, delay in moments(2)]

    def crash_soon(progress: ImportProgress) -> None:
        for killer in crashes:
            killer(progress)

    (report,) = hapticdb.import_files(url, [file], options(layout), crash_soon)
    assert len(report.added) == N_PARTS
    assert valid_contents(url) == undisturbed[layout]


@pytest.mark.long
@pytest.mark.usefixtures("_impatient")
def test_write_server_crash_rolls_back(
    server: Server, url: str, file: Path, edited: list[Contents]
) -> None:
    with small(url, file) as env:
        before = contents(env)
        for (name, edit), after in zip(EDITS, edited, strict=True):
            for step in steps_of(name):
                with pytest.MonkeyPatch.context() as patch:
                    After(patch, ServerTables, step, lambda: kill(server))
                    with pytest.raises(
                        hapticdb.errors.ConnectionLostError, match="cannot be reached"
                    ):
                        edit(env)
                server.start()
                assert contents(env) == before, step
            edit(env)
            before = contents(env)
            assert before == after
        assert_valid(env)


@pytest.mark.parametrize(("name", "step"), [(n, s) for n, _ in EDITS for s in steps_of(n)])
def test_write_reconnects_after_crash(
    crashing: tuple[Server, Environment], name: str, step: str
) -> None:
    server, env = crashing
    before = env.store.revision()
    first = env.objects()[0].id
    with pytest.MonkeyPatch.context() as patch:
        After(patch, ServerTables, step, lambda: crash(server))
        if name == "move":
            env.move(first, PLACE)
        else:
            env.remove(first)
    assert env.store.revision() == before + 1
    *_, change = env.store.changes()
    assert (change.action, change.id) == (name, first)
    assert_valid(env)


@pytest.fixture
def path() -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    rng = np.random.default_rng(5)
    return [placement(*rng.uniform(-0.3, 0.3, 3)) for _ in range(60)]


def test_touch_path_through_server_crash(
    server: Server,
    url: str,
    file: Path,
    sphere: PointShell,
    path: list[np.ndarray[Any, np.dtype[np.float64]]],
) -> None:
    small(url, file).close()
    with hapticdb.open(url, read_only=True) as env:
        expected = [felt(env, sphere, pose) for pose in path]
        assert sum(bool(hits) for _, hits, _ in expected) > 10
        killer = threading.Timer(0.01, crash, [server])
        killer.start()
        n_frames = 0
        deadline = time.monotonic() + TIMEOUT
        while killer.is_alive() or n_frames < 3 * len(path):
            assert time.monotonic() < deadline
            for pose, wanted in zip(path, expected, strict=True):
                strategy = STRATEGIES[n_frames % len(STRATEGIES)]
                assert felt(env, sphere, pose, strategy) == wanted
                n_frames += 1
