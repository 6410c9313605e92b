"""Damage to a file: `check` finds what was altered in rows, and no damage ends in a traceback."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import hapticdb
from banded import write_points
from draws import is_every
from hapticdb import Grid, PointShell
from hapticdb.grid import CurveName
from hapticdb.paper.strategies import STRATEGIES, Strategy
from hapticdb.store.base import Layout
from hapticdb.store.sqlite.raw import PAGE_BYTES
from voxels import blob, write_voxels

KINDS: tuple[tuple[Layout, CurveName, bool], ...] = (
    ("brick", "z", True),
    ("brick", "hilbert", False),
    ("voxel", "z", False),
)
"""Layouts and curves, and whether there are distances."""
PLACES: tuple[tuple[tuple[float, float, float], tuple[Strategy, ...]], ...] = (
    ((0.025, 0.025, 0.03), STRATEGIES),
    ((0.04, 0.025, 0.04), ("array", "cbgroup")),
    ((0.02, 0.04, 0.045), ("maxgap",)),
)
"""Positions of the tool in metres, and the strategies that are asked there."""
OF_ROWS = "SELECT pageno - 1 FROM dbstat WHERE name IN ('brick', 'voxel')"


class Sample(NamedTuple):
    """An environment to damage.

    file, log : with the last commit in the log alone; whole : a file with all commits; of_rows :
    its pages, from 0, that hold rows or distances; truths : the answers after each commit.
    """

    file: bytes
    log: bytes
    whole: bytes
    of_rows: list[int]
    truths: list[str]


def answers(path: Path) -> str:
    """What a user feels of an environment; raises what a user is told."""
    shell = PointShell.sphere(0.012, 60)
    with hapticdb.open(path, read_only=True) as env:
        objects = env.objects()
        told: list[Any] = [env.size().rows, [len(env.voxels(obj.id)) for obj in objects]]
        poses = np.tile(np.eye(4), (len(PLACES), 1, 1))
        for pose, (place, strategies) in zip(poses, PLACES, strict=True):
            pose[:3, 3] = place
            for strategy in strategies:
                touch = env.touch(shell, pose, strategy, law="plane")
                told.append((touch.force.tolist(), touch.torque.tolist(), touch.pairs.tolist()))
        with env.batch_tool(
            shell, jobs=1
        ) as batch_tool:  # the distance law where there are distances
            told.append(batch_tool.touch(poses).forces.tolist())
    return json.dumps(told)


def made(path: Path, layout: Layout, curve: CurveName, *, distances: bool) -> Sample:
    log = Path(f"{path}-wal")
    grid = Grid(0.001, (0, 0, 0), 6, curve)
    hapticdb.create(path, grid, layout=layout, distances=distances).close()
    truths: list[str] = []
    for n, centre in enumerate([(25, 25, 25), (40, 25, 35), (20, 40, 40)]):
        with hapticdb.open(path) as env:
            if distances:
                rng = np.random.default_rng(n)
                write_points(env.store, rng.normal(centre, 4.0, (60, 3)).clip(1, 62), f"{n}")
            else:
                write_voxels(env.store, blob(n, centre, 10), f"{n}")
            env.analyze()  # or each damaged copy takes its own statistics and costs
            if not n:
                env.calibrate()
            truths.append(answers(path))
            file, written = path.read_bytes(), log.read_bytes()
            pages = env.store._connection.fetch(OF_ROWS)  # type: ignore[attr-defined]
    return Sample(file, written, path.read_bytes(), [row[0] for row in pages], truths)


def a_bit(data: bytearray, at: int, _: int, rng: np.random.Generator) -> None:
    data[at * PAGE_BYTES + rng.integers(PAGE_BYTES)] ^= 1 << rng.integers(8)


def noise(data: bytearray, at: int, _: int, rng: np.random.Generator) -> None:
    start = at * PAGE_BYTES + int(rng.integers(PAGE_BYTES - 600))
    data[start : start + 600] = rng.bytes(600)


def zeros(data: bytearray, at: int, _: int, rng: np.random.Generator) -> None:
    start = at * PAGE_BYTES + int(rng.integers(PAGE_BYTES - 600))
    data[start : start + 600] = bytes(600)


def a_zeroed_page(data: bytearray, at: int, _: int, __: object) -> None:
    data[page(at)] = bytes(PAGE_BYTES)


def swapped_pages(data: bytearray, at: int, other: int, _: object) -> None:
    data[page(at)], data[page(other)] = data[page(other)], data[page(at)]


def a_duplicated_page(data: bytearray, at: int, other: int, _: object) -> None:
    data[page(at)] = data[page(other)]


def a_cut(data: bytearray, at: int, _: int, rng: np.random.Generator) -> None:
    del data[at * PAGE_BYTES + int(rng.integers(PAGE_BYTES)) :]


def page(number: int) -> slice:
    return slice(number * PAGE_BYTES, (number + 1) * PAGE_BYTES)


DAMAGES: tuple[Callable[[bytearray, int, int, np.random.Generator], None], ...] = (
    a_bit, a_bit, noise, zeros, a_zeroed_page, swapped_pages, a_duplicated_page, a_cut,
)  # fmt: skip


def outcome(path: Path, content: bytes, log: bytes = b"") -> tuple[bool, str]:
    """Whether `check` finds a file sound, and its answers: empty if they are an error of ours."""
    for suffix, part in (("", content), ("-wal", log), ("-shm", b"")):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
        if part:
            Path(f"{path}{suffix}").write_bytes(part)
    try:
        is_sound = hapticdb.check_environment(path).is_sound
    except hapticdb.errors.HapticDBError:
        is_sound = False
    try:
        return is_sound, answers(path)
    except hapticdb.errors.HapticDBError as error:
        return is_sound, "" if "\n" not in str(error) else str(error)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "cases",
    [8, pytest.param(1000 if is_every() else 200, marks=pytest.mark.long)],
    ids=["short", "long"],
)
def test_check_environment_damaged_rows(
    tmp_path: Path, kind: tuple[Layout, CurveName, bool], cases: int
) -> None:
    """Damage elsewhere, as in the record of an object, is told or harmless, or names are wrong."""
    layout, curve, distances = kind
    sample = made(tmp_path / "e.db", layout, curve, distances=distances)
    n_pages = len(sample.whole) // PAGE_BYTES
    found = 0
    for seed in range(cases):
        rng = np.random.default_rng(seed)
        data = bytearray(sample.whole)
        damage, is_of_rows = DAMAGES[seed % len(DAMAGES)], seed % 3 > 0
        while data == sample.whole:
            at = int(rng.choice(sample.of_rows if is_of_rows else n_pages))
            damage(data, at, int(rng.integers(1, n_pages)), rng)
        is_sound, answered = outcome(tmp_path / "e.db", bytes(data))
        found += not is_sound
        if is_of_rows and is_sound:
            assert answered == sample.truths[-1], f"{damage.__name__} of page {at}, seed {seed}"
    assert found > cases / 4


def test_check_environment_damaged_log(tmp_path: Path) -> None:
    sample = made(tmp_path / "e.db", "brick", "z", distances=False)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        log = bytearray(sample.log)
        if seed % 3:
            log[int(rng.integers(len(log)))] ^= 1 << rng.integers(8)
        else:
            del log[int(rng.integers(len(log))) :]
        assert outcome(tmp_path / "e.db", sample.file, bytes(log))[1] in {"", *sample.truths[1:]}
