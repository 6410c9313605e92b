"""Workers of dask.distributed find what one process finds, bit for bit, whatever is lost."""

import contextlib
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import LocalCluster

import hapticdb
from assemblies import Mesh, ball, row_of_boxes, rows_of, small_options, write_obj
from children import finished
from command_line import Run, command, poses, refused
from disassembly_scenes import STACK
from disassembly_scenes import made as made_of
from hapticdb import ImportOptions, disassemble, find_clashes
from hapticdb.batches import batch_tool
from hapticdb.clashes import search as clashing
from hapticdb.cluster import scheduler as cluster
from hapticdb.errors import ClusterError, UsageError
from hapticdb.ingest.files import ImportProgress
from hapticdb.transfer import copy_environment
from scheduling import kill_a_worker, scheduling, stop_scheduler
from servers import Place


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """A scheduler with two workers in processes of their own."""
    with scheduling() as address:
        yield address


@pytest.fixture(scope="module")
def threads() -> Iterator[str]:
    """A scheduler with two workers in threads of this process, which begin at once."""
    with LocalCluster(
        host="127.0.0.1", protocol="tcp://", n_workers=2, threads_per_worker=1, processes=False,
        dashboard_address="127.0.0.1:0", silence_logs=50,
    ) as made:  # fmt: skip
        yield made.scheduler_address


def balls(folder: Path, n_balls: int) -> Path:
    """A file of balls, two of each shape, which meet their neighbours."""
    parts: dict[str, Mesh] = {}
    for n in range(n_balls):
        points, faces = ball((0.03 * (n % 4) - 0.05, 0.025 * (n // 4) - 0.1, 0.0), 0.02, 6 + n // 2)
        parts[f"ball {n}"] = points, faces
    return write_obj(folder / "balls.obj", parts)


def on(address: str) -> ImportOptions:
    return ImportOptions(grid=small_options().grid, on=address)


def pairs_of(path: Path) -> list[tuple[object, ...]]:
    with hapticdb.open(path, read_only=True) as env:
        return [tuple(row) for row in env.store.pairs()]


@pytest.mark.parametrize("kind", ["threads", pytest.param("scheduler", marks=pytest.mark.long)])
def test_cluster_import_and_clashes_equal_one_process(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scheduler: str = request.getfixturevalue(kind)
    monkeypatch.setattr(clashing, "PIECE", 3)
    file, here, there = balls(tmp_path, 12), tmp_path / "here.db", tmp_path / "there.db"
    told: list[ImportProgress] = []
    hapticdb.import_files(here, [file], small_options())
    hapticdb.import_files(there, [file], on(scheduler), told.append)
    assert rows_of(there) == rows_of(here)
    assert [now.parts_done for now in told] == [*range(1, 13)]
    with hapticdb.open(here) as env, hapticdb.open(there) as other:
        measured: list[tuple[int, int]] = []
        found = find_clashes(other, on=scheduler, progress=lambda *now: measured.append(now))
        assert found.pairs == find_clashes(env).pairs
        assert found.counts()["overlapping"] > 5
        assert measured[-1] == (found.measured, found.measured)
    assert pairs_of(here) == pairs_of(there)


@pytest.mark.long
def test_cluster_touch_equals_one_process(
    scheduler: str, scene: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_tool, "TASK", 7)
    poses(scene.with_name("way.csv"), *((0.002 * n, 0.0, 0.0635) for n in range(50)))
    asked = ("touch", scene.name, "--tool", "tool.npz", "--poses", "way.csv", "--exclude", "box1")
    assert run(*asked, "--out", "here.npz")[0] == 0
    code, out, _ = run(*asked, "--out", "there.npz", "--on", scheduler)
    assert (code, "50: " in out) == (0, True)
    here, there = (np.load(scene.with_name(f"{name}.npz")) for name in ("here", "there"))
    assert here["contacts"].any()
    for name in here.files:
        assert here[name].tobytes() == there[name].tobytes()


@pytest.mark.long
def test_cluster_disassemble_equals_one_process(scheduler: str, tmp_path: Path) -> None:
    with hapticdb.open(made_of(tmp_path, STACK), read_only=True) as env:
        asked: dict[str, Any] = {"motions": 0, "keep": ["pot"]}
        here = disassemble(env, "content", **asked)
        told: list[tuple[int, int]] = []
        there = disassemble(
            env, "content", on=scheduler, progress=lambda *now: told.append(now), **asked
        )
    assert [done for done, _ in told] == list(range(1, len(told) + 1))
    assert len(told) >= len(there.steps)
    assert all(done <= known for done, known in told)
    assert [step.excluded for step in there.steps] == [step.excluded for step in here.steps]
    for one, other in zip(here.steps, there.steps, strict=True):
        assert one.found.path is not None
        assert other.found.path is not None
        assert one.found.path.poses.tobytes() == other.found.path.poses.tobytes()
    assert len(there.steps) == 3


@pytest.mark.long
def test_cluster_lost_worker_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clashing, "PIECE", 1)
    file, here, there = balls(tmp_path, 24), tmp_path / "here.db", tmp_path / "there.db"
    hapticdb.import_files(here, [file], small_options())
    lost: list[int] = []
    with scheduling() as address:

        def lose(n_done: int) -> None:
            if n_done >= 4 and not lost:
                lost.append(n_done)
                kill_a_worker(address)

        hapticdb.import_files(there, [file], on(address), lambda now: lose(now.parts_done))
        assert rows_of(there) == rows_of(here)
        with hapticdb.open(here) as env, hapticdb.open(there) as other:
            assert lost.pop()
            found = find_clashes(other, on=address, progress=lambda done, _: lose(done))
            assert found.pairs == find_clashes(env).pairs
            assert lost
    assert pairs_of(here) == pairs_of(there)


@pytest.mark.long
def test_cluster_workers_read_server(
    scheduler: str, place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clashing, "PIECE", 1)
    url, path = place(), row_of_boxes(tmp_path / "row.db", 5, 0.099)
    copy_environment(path, url)
    with hapticdb.open(url) as env, hapticdb.open(path) as alone:
        assert find_clashes(env, on=scheduler).pairs == find_clashes(alone).pairs
        assert len(env.store.pairs().rows) == 4


@pytest.mark.long
def test_cluster_resumes_after_ctrl_c(scheduler: str, tmp_path: Path) -> None:
    file, here, there = balls(tmp_path, 40), tmp_path / "here.db", tmp_path / "there.db"
    hapticdb.import_files(here, [file], small_options())
    grid = ("--bits", 5, "--voxel-size", 0.01, "--origin=-0.16,-0.16,-0.16")
    again = command("import", there, file, *grid, "--on", scheduler)
    code = (
        "import os, signal, sys\nfrom hapticdb.ingest import files\nadd = files.added_or_present\n"
        "def added(*parts):\n    done.append(add(*parts))\n"
        "    if len(done) == 9: os.kill(os.getpid(), signal.SIGINT)\n    return done[-1]\n"
        "done = []\nfiles.added_or_present = added\n"
        "from hapticdb.__main__ import main\nsys.exit(main())"
    )
    done = finished([sys.executable, "-c", code, *again[3:]])
    assert done.returncode == 130, done.stderr
    assert "goes on from there" in done.stderr
    assert done.stderr.count("\n") == 1
    with hapticdb.open(there, read_only=True) as env:
        assert 8 <= len(env.objects()) < 40
    assert finished(again).returncode == 0
    assert rows_of(there) == rows_of(here)


def test_cluster_missing_scheduler(
    run: Run, scene: Path, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "LONGEST_S", 0.5)
    refused(run("clashes", scene, "--on", "tcp://127.0.0.1:1"), "no scheduler at tcp://127.0.0.1:1")
    refused(run("clashes", scene, "--on", "nonsense://x"), "no scheduler at nonsense://x")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        refused(run("import", "new.db", made / "boxes.glb", "--on", address), "no scheduler at")
    assert not scene.with_name("new.db").exists()
    asked = ("touch", scene, "--tool", "tool.npz", "--poses", "path.csv")
    refused(run(*asked, "--on", "tcp://127.0.0.1:1"), "--on has no meaning without --out")
    refused(run(*asked, "--on", "gpu", "--out", "a.npz"), "device 'gpu'")
    refused(run("extract", scene, "box1", "--on", "tcp://127.0.0.1:1"), "--disassemble")
    refused(run("clashes", scene, "--of", "1", "--turn", "z", "--on", "tcp://x:1"), "--on")
    with pytest.raises(UsageError, match="threads of their own"):
        ImportOptions(jobs=2, on=address)
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused(run("clashes", scene, "--on", "tcp://127.0.0.1:1"), "install it with")


def test_cluster_incompatible_workers(
    threads: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hapticdb.open(scene) as env:
        env.address = str(tmp_path / "none.db")
        with pytest.raises(ClusterError, match="does not reach the environment: no environment"):
            find_clashes(env, within=0.2, on=threads)
        env.address = str(row_of_boxes(tmp_path / "other.db", 4))
        with pytest.raises(ClusterError, match="another environment"):
            find_clashes(env, within=0.2, on=threads)
        monkeypatch.setattr(cluster, "version", lambda _: "9.9")
        with pytest.raises(
            ClusterError, match=rf"has {hapticdb.__version__} hapticdb: install 9\.9 there"
        ):
            find_clashes(env, within=0.2, on=threads)


@pytest.mark.long
def test_cluster_no_worker(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LONGEST_S", 3.0)
    with (
        scheduling(0) as address,
        hapticdb.open(scene) as env,
        pytest.raises(ClusterError, match="has no worker: start some"),
    ):
        find_clashes(env, within=0.2, on=address)


@pytest.mark.long
@pytest.mark.parametrize("is_stopped", [False, True])
def test_cluster_scheduler_lost_or_hanging(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_stopped: bool
) -> None:
    monkeypatch.setattr(cluster, "LONGEST_S", 2.0)
    file, there = balls(tmp_path, 24), tmp_path / "there.db"
    with contextlib.ExitStack() as running:
        address = running.enter_context(scheduling())

        def leave(now: ImportProgress) -> None:
            if now.parts_done == 3:
                stop_scheduler(address) if is_stopped else running.close()

        with pytest.raises(ClusterError, match="the scheduler went away"):
            hapticdb.import_files(there, [file], on(address), leave)
    with hapticdb.open(there, read_only=True) as env:
        assert len(env.objects()) >= 3
