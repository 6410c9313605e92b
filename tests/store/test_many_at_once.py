"""Many clients on PostgreSQL: each frame is of one revision, none blocks, no write is lost."""

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess as Process
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest

import hapticdb
from assemblies import ball, box, placement, small_options, write_obj
from children import TIMEOUT, end_forked, joined, received, until
from hapticdb import Environment, PointShell
from hapticdb.cli import main
from hapticdb.errors import StuckError
from hapticdb.ingest.geometry import parts_of
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.store.base import Object, Rows
from hapticdb.store.postgres.address import parse
from servers import Place
from validity import assert_valid

N_READERS = 8
ENOUGH_FRAMES = 10
"""Frames of a reader before it may report "seen"."""
N_IMPORTS = 2
"""How often the balls are imported and removed."""
LEFT, RIGHT = (-0.09, 0.0, 0.0), (0.09, 0.0, 0.0)
"""The shuttle's two places (metres); half of the shell's points are at each."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files: a shuttle at its left place, and eight balls that are added and removed in pairs."""
    made = tmp_path_factory.mktemp("scene")
    write_obj(made / "shuttle.obj", {"shuttle": box((-0.12, -0.03, -0.03), (-0.06, 0.03, 0.03))})
    balls = {f"ball {n}": ball((0.02 * n - 0.07, 0.1, 0.0), 0.03) for n in range(8)}
    write_obj(made / "balls.obj", balls)
    return made


@pytest.fixture
def url(place: Place, folder: Path) -> str:
    where = place()
    hapticdb.import_files(where, [folder / "shuttle.obj"], small_options())
    return where


def two_tools() -> PointShell:
    """A shell of 400 points: 200 inside the shuttle's left place, 200 inside its right place."""
    rng = np.random.default_rng(1)
    half = rng.uniform(-0.035, 0.035, (200, 3))
    points = np.concatenate([half + LEFT, half + RIGHT])
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointShell(points=points, normals=normals, center=np.zeros(3), is_closed=True)


def read(url: str, number: int, said: Connection) -> None:
    """Touch until a message says stop. Send "seen" after enough frames with hits on both sides."""
    shell = two_tools()
    strategy = STRATEGIES[number % len(STRATEGIES)]
    sides: set[bool] = set()
    n_frames, is_content = 0, False
    with hapticdb.open(url, read_only=True) as env:
        env.touch(shell, np.eye(4), strategy, law="plane")
        said.send("ready")
        while not said.poll():
            if n_frames >= ENOUGH_FRAMES and len(sides) == 2 and not is_content:
                is_content = True
                said.send("seen")
            touch = env.touch(shell, np.eye(4), strategy, law="plane")
            n_left = int((touch.hits < 200).sum())
            n_right = len(touch.hits) - n_left
            assert min(n_left, n_right) == 0 < max(n_left, n_right), strategy
            (shuttle,) = touch.objects
            # the object that the frame returns is at the place that the frame has hit
            assert (shuttle.bounds[0, 0] > 0) == (n_left == 0), strategy
            sides.add(n_left == 0)
            with env.store.snapshot():
                objects = env.objects()
                rows = env.store.scan(np.array([0]), np.array([2**62]))
            bits = np.unpackbits(rows.occupancy.reshape(-1, 64), axis=1).sum(axis=1)
            counted = {i: int(bits[rows.ids == i].sum()) for i in np.unique(rows.ids).tolist()}
            assert counted == {obj.id: obj.voxels for obj in objects}
            n_frames += 1
    said.send("done")


@contextlib.contextmanager
def processes(
    target: Callable[..., object], *arguments: tuple[Any, ...]
) -> Iterator[list[Process]]:
    """One process for each tuple of arguments; all are ended on exit."""
    # forked: a spawned process would import for seconds
    made = [multiprocessing.get_context("fork").Process(target=target, args=a) for a in arguments]
    for process in made:
        process.start()
        assert process.pid is not None
        end_forked(process.pid)
    try:
        yield made
    finally:
        for process in made:
            process.kill()
            process.join(TIMEOUT)


def places_of(env: Environment) -> list[tuple[Object, Rows]]:
    """The shuttle's record and rows at its left place, then at its right place."""
    ((_, part),) = parts_of(env.store, [env.object(1)])
    found: list[tuple[Object, Rows]] = []
    for x in (0.0, 0.18):
        placed = placement(x, 0, 0)
        rows, n_voxels = rows_of_part(part, env.grid, env.layout, placed)
        points = part.world_points(placed)
        bounds = np.stack([points.min(axis=0), points.max(axis=0)])
        shuttle = replace(
            env.object(1), transform=placed, bounds=bounds, voxels=n_voxels, revision=0
        )
        found.append((shuttle, rows))
    return found


@pytest.mark.long
def test_touch_eight_readers_one_revision_each(url: str, folder: Path) -> None:
    """One writer moves the shuttle, one imports and removes balls: no frame mixes revisions."""
    assert len(STRATEGIES) <= N_READERS
    pipes = [multiprocessing.Pipe() for _ in range(N_READERS)]
    failed: list[Exception] = []

    def import_and_remove() -> None:
        try:
            for _ in range(N_IMPORTS):
                hapticdb.import_files(url, [folder / "balls.obj"])
                with hapticdb.open(url) as other:
                    for obj in other.objects()[1:]:
                        other.remove(obj.id)
        except Exception as error:  # noqa: BLE001 - told below
            failed.append(error)

    with (
        processes(read, *((url, n, theirs) for n, (_, theirs) in enumerate(pipes))) as children,
        hapticdb.open(url) as env,
    ):
        places = places_of(env)
        for ours, theirs in pipes:
            theirs.close()
            assert received(ours) == "ready"
        importer = threading.Thread(target=import_and_remove, daemon=True)
        importer.start()
        n_moves = 0
        waiting = list(children)
        deadline = time.monotonic() + TIMEOUT
        while importer.is_alive() or waiting:
            assert time.monotonic() < deadline
            assert all(child.is_alive() for child in children)
            n_moves += 1
            env.store.replace(*places[n_moves % 2])
            waiting = [
                child for (ours, _), child in zip(pipes, children, strict=True) if not ours.poll()
            ]
        joined(importer)
        assert not failed
        for ours, _ in pipes:
            ours.send("stop")
        for (ours, _), child in zip(pipes, children, strict=True):
            assert [received(ours), received(ours)] == ["seen", "done"]
            child.join(TIMEOUT)
            assert child.exitcode == 0
        assert_valid(env)
        assert env.store.revision() == 1 + n_moves + N_IMPORTS * 2 * 8
        assert [obj.name for obj in env.objects()] == ["shuttle"]


def test_snapshot_open_blocks_no_writer(url: str, folder: Path) -> None:
    shell = two_tools()
    with hapticdb.open(url, read_only=True) as reader, reader.store.snapshot():
        before = reader.touch(shell, np.eye(4))
        (report,) = hapticdb.import_files(url, [folder / "balls.obj"])
        assert len(report.added) == 8
        with hapticdb.open(url) as writer:
            writer.move(1, placement(0.18, 0, 0))
            writer.remove(2)
            writer.store.analyze(10_000, anew=True)
        after = reader.touch(shell, np.eye(4))
        assert after.hits.tolist() == before.hits.tolist()
        assert len(reader.objects()) == 1
    with hapticdb.open(url, read_only=True) as reader:
        assert len(reader.objects()) == 8


@contextlib.contextmanager
def unfinished_move(url: str) -> Iterator[psycopg.Connection]:
    """A writer in the middle of a transaction: it has the write lock, and its rows are deleted."""
    address = parse(url)
    with psycopg.connect(address.conninfo) as writer:
        writer.execute(f"SET search_path = {address.environment}")
        writer.execute("UPDATE environment SET revision = revision + 1")
        writer.execute("DELETE FROM brick")
        yield writer
        writer.rollback()


def test_move_remove_lock_timeout(url: str) -> None:
    impatient = f"{url}&options=-clock_timeout%3D200"
    with hapticdb.open(impatient) as env:
        with unfinished_move(url):
            for edit in (partial(env.remove, 1), partial(env.move, 1, np.eye(4))):
                with pytest.raises(hapticdb.errors.BusyError, match="try again later") as told:
                    edit()
                assert "\n" not in str(told.value)
            assert len(env.objects()) == 1
        env.move(1, placement(0.18, 0, 0))
        assert_valid(env)


def test_shift_two_writers_both_count(url: str) -> None:
    """Each writer reads, shifts and writes; a writer that was overtaken reads again."""
    n_each, step = 3, "0.001,0,0"
    with processes(shift, *((url, step, n_each) for _ in range(2))) as writers:
        for writer in writers:
            writer.join(TIMEOUT)
        assert [writer.exitcode for writer in writers] == [0, 0]
    with hapticdb.open(url) as env:
        assert env.object(1).transform[0, 3] == pytest.approx(0.001 * 2 * n_each)
        assert env.store.revision() == 1 + 2 * n_each
        assert_valid(env)


def shift(url: str, step: str, n_times: int) -> None:
    for _ in range(n_times):
        assert main(["move", url, "1", "--translate", step, "--json"]) == 0


def test_touch_statement_timeout(url: str, admin: psycopg.Connection) -> None:
    shell, expected = two_tools(), hits_at(url)
    name = parse(url).environment
    with hapticdb.open(f"{url}&options=-cstatement_timeout%3D400", read_only=True) as env:
        # the first frame that groups by cost measures the costs, which a lock would stop
        until(lambda: answers(env, shell, expected, strategy="cbgroup"))
        for strategy in STRATEGIES[1:]:  # `auto` has its bricks in memory
            with admin.transaction():
                admin.execute(f"LOCK TABLE {name}.brick IN ACCESS EXCLUSIVE MODE")
                with pytest.raises(StuckError, match="did not answer in time") as told:
                    env.touch(shell, np.eye(4), strategy, law="plane")
            assert "\n" not in str(told.value)
            until(partial(answers, env, shell, expected, strategy=strategy, law="plane"))


def hits_at(url: str) -> list[int]:
    with hapticdb.open(url, read_only=True) as env:
        return list(env.touch(two_tools(), np.eye(4)).hits)


def answers(env: Environment, shell: PointShell, wanted: list[int], **how: Any) -> bool:  # noqa: ANN401 - of `touch`
    """Whether a touch hits these points; not where a busy machine takes more than its time."""
    try:
        return list(env.touch(shell, np.eye(4), **how).hits) == wanted
    except StuckError:
        return False


@contextlib.contextmanager
def stopped(pid: int) -> Iterator[None]:
    """Stop a process of the server, and let it continue on exit."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def test_touch_ctrl_c_with_hanging_server(url: str, caplog: pytest.LogCaptureFixture) -> None:
    """psycopg's own handling, which waits for the server, would write to its log."""
    shell, expected = two_tools(), hits_at(url)
    with hapticdb.open(url, read_only=True) as env:
        until(lambda: answers(env, shell, expected))
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with stopped(backend_of(env)):
                threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
                with pytest.raises(KeyboardInterrupt):
                    env.touch(shell, np.eye(4), "array")
        finally:
            signal.signal(signal.SIGINT, before)
        assert not [one for one in caplog.records if one.name.startswith("psycopg")]
        until(lambda: answers(env, shell, expected))


def backend_of(env: Environment) -> int:
    return int(env.store._connection.driver.info.backend_pid)  # type: ignore[attr-defined]
