"""Wrong uses of the Python API raise an error of one clear line; no wrong answer is returned."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from children import exit_code, joined
from hapticdb import Environment, Grid, PointShell
from voxels import floor_voxels, write_voxels


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    env = hapticdb.create(tmp_path / "e.db", Grid(0.005, (-0.16, -0.16, -0.16), 6))
    write_voxels(env.store, floor_voxels(env.grid))
    return env


def test_ids_bad_type_or_missing_object(env: Environment, sphere: PointShell) -> None:
    wrong: tuple[Any, ...] = ("1", 1.7, None, [1], True)
    for ask in (env.voxels, env.object, env.remove):
        for one in wrong:
            with pytest.raises(hapticdb.errors.UsageError, match="give an int"):
                ask(one)
        for one in (-1, 0, 2, 10**30):
            with pytest.raises(hapticdb.errors.ObjectNotFoundError, match=f"no object {one}"):
                ask(one)
    with pytest.raises(hapticdb.errors.UsageError, match="a word that selects one object"):
        env.move(["ball"], np.eye(4))  # type: ignore[arg-type]
    with pytest.raises(hapticdb.errors.ObjectNotFoundError, match="no object 2"):
        env.touch(sphere, np.eye(4), exclude=[2])
    assert len(env.voxels(np.int64(1))) == env.object(1).voxels  # type: ignore[arg-type]


def test_touch_exclude_collections(env: Environment, sphere: PointShell) -> None:
    empties: list[Any] = [(), [], np.array([], dtype=np.int64), set(), iter(())]
    for nobody in empties:
        assert len(env.touch(sphere, np.eye(4), exclude=nobody).hits)
    for floor in ([1], (1,), np.array([1, 1]), {1}, iter([1])):
        assert not len(env.touch(sphere, np.eye(4), exclude=floor).hits)
    single: tuple[Any, ...] = (1, [True], b"\x01", bytearray(1), memoryview(b"\x01"), [np.True_])
    for wrong in single:
        with pytest.raises(hapticdb.errors.UsageError, match=r"give an id|give ids"):
            env.touch(sphere, np.eye(4), exclude=wrong)


def test_touch_maxgap_checked_for_any_strategy(env: Environment, sphere: PointShell) -> None:
    for strategy in ("auto", "points", "maxgap"):
        with pytest.raises(hapticdb.errors.UsageError, match="MAXGAP -1"):
            env.touch(sphere, np.eye(4), strategy, maxgap=-1)


def test_environment_other_thread_refused(env: Environment, sphere: PointShell) -> None:
    told: list[str] = []

    def use() -> None:
        for ask in (env.objects, lambda: env.remove(1), lambda: env.touch(sphere, np.eye(4))):
            with pytest.raises(hapticdb.errors.UsageError, match="the thread that opened it"):
                ask()
        told.append("all")

    thread = threading.Thread(target=use)
    thread.start()
    joined(thread)
    assert told == ["all"]
    assert len(env.objects()) == 1


def test_import_files_needs_list(tmp_path: Path) -> None:
    with pytest.raises(hapticdb.errors.UsageError, match="give a list"):
        hapticdb.import_files(tmp_path / "x.db", "part.stl")
    with pytest.raises(hapticdb.errors.UsageError, match="no files"):
        hapticdb.import_files(tmp_path / "x.db", [])


def test_create_not_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for url in (":memory:", "file:e.db", "", "mysql://host/e"):
        with pytest.raises(hapticdb.errors.UsageError):
            hapticdb.create(url, Grid(0.01, (0, 0, 0), 4))
    assert not list(tmp_path.iterdir())


def test_poses_not_real_arrays(env: Environment, sphere: PointShell) -> None:
    given: tuple[tuple[Any, str], ...] = (
        (np.eye(4) * 1j, "complex128"), ([[1, 2], [3]], "object"), (np.eye(4) == 1.0, "bool"),
        (np.ma.masked_array(np.eye(4), mask=np.eye(4) == 1.0), "masked"),
        (np.full((4, 4), "1"), "<U1"),
    )  # fmt: skip
    asked: tuple[Callable[[Any], object], ...] = (
        lambda wrong: env.touch(sphere, wrong),
        lambda wrong: env.move(1, wrong),
        lambda wrong: hapticdb.sweep(env, PointShell.sphere(0.01), wrong),
        lambda wrong: hapticdb.write_poses("p.csv", wrong),
        lambda wrong: PointShell.from_mesh(wrong, [[0, 1, 2]]),
    )
    for wrong, told in given:
        for ask in asked:
            with pytest.raises(hapticdb.errors.UsageError, match=told):
                ask(wrong)


def test_poses_integers_and_lists(env: Environment, sphere: PointShell) -> None:
    wanted = env.touch(sphere, np.eye(4)).force
    for pose in (np.eye(4, dtype=np.int32), np.eye(4).tolist(), np.asfortranarray(np.eye(4))):
        assert (env.touch(sphere, pose).force == wanted).all()


def test_shell_points_and_seed_integers() -> None:
    given: tuple[Any, ...] = (1.5, "12", True, None, np.float64(3))
    for wrong in given:
        with pytest.raises(hapticdb.errors.UsageError, match="whole number"):
            PointShell.sphere(0.5, wrong)
        with pytest.raises(hapticdb.errors.UsageError, match="whole number"):
            PointShell.from_mesh(np.eye(3), [[0, 1, 2]], seed=wrong)
    assert len(PointShell.sphere(0.5, np.int64(12))) == 12  # type: ignore[arg-type]


def test_environment_forked_process_refused(env: Environment, sphere: PointShell) -> None:
    """Two processes that share one SQLite connection would damage the file."""
    answer, question = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            env.touch(sphere, np.eye(4))
            told = "nothing was refused"
        except hapticdb.errors.UsageError as error:
            told = str(error)
        os.write(question, told.encode())
        os._exit(0)
    os.close(question)
    with os.fdopen(answer, "rb") as heard:
        told = heard.read().decode()
    assert exit_code(pid) == 0
    assert "belongs to the thread that opened it, in its own process" in told
    assert len(env.touch(sphere, np.eye(4)).hits) > 0
