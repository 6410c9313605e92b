"""A law from outside the package: a plain penalty on occupancy, through frames of both kinds."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.kernels import force_law as kernels
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from naive_frame import NaiveTouch, touch_of_shell
from session.worlds import random_shell
from voxels import blob, write_voxels

ORIGIN = (-0.31, 0.17, -0.05)
SIZE = 0.013
BITS = 6
STIFFNESS = 750.0
Array = NDArray[np.float64]


class Depth(NamedTuple):
    """Depth of a hit in voxels, as a product."""

    scale: float
    parts: Array


class PenaltyNumbers(NamedTuple):
    """A plain penalty as kernels take it, with numbers of all kinds that a law may have."""

    stiffness: float
    is_on: bool
    depth: Depth


def penalty(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """Every hit is felt half a voxel deep."""
    if not law.is_on:
        raise ValueError("this law is off")
    return law.depth.scale * law.depth.parts[1] * size, 1.0


kernels.define(PenaltyNumbers, kernels.Leaves(respond=penalty))


class Penalty:
    """A plain penalty on occupancy, as `Environment.touch` takes a law."""

    stiffness = STIFFNESS

    def __init__(self, *, is_on: bool = True) -> None:
        self.for_kernels = PenaltyNumbers(STIFFNESS, is_on, Depth(2.0, np.array([np.nan, 0.25])))


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    env = hapticdb.create(tmp_path / "e.db", Grid(SIZE, ORIGIN, BITS))
    for seed, center in ((1, (20, 20, 20)), (2, (26, 22, 20))):
        write_voxels(env.store, blob(seed, center), f"blob {seed}")
    return env


def poses() -> Array:
    found = np.tile(np.eye(4), (4, 1, 1))
    found[:, :3, 3] = np.array(ORIGIN) + SIZE * (np.array([22.0, 21.0, 20.0]))
    found[1:, :3, 3] += np.random.default_rng(1).normal(size=(3, 3)) * 4 * SIZE
    return found


def expected(shell: PointShell, pose: Array) -> NaiveTouch:
    plain: dict[tuple[int, int, int], set[int]] = {}
    for seed, center in ((1, (20, 20, 20)), (2, (26, 22, 20))):
        for i, j, k in blob(seed, center).tolist():
            plain.setdefault((i, j, k), set()).add(seed)
    return touch_of_shell(
        plain, Grid(SIZE, ORIGIN, BITS), shell, pose,
        stiffness=STIFFNESS, depth_of=lambda _p, _n, _c, size: 0.5 * size,
    )  # fmt: skip


@pytest.mark.long
def test_frames_users_law_database_equals_cells(env: Environment) -> None:
    shell = random_shell(300, 300, 8.0, SIZE)
    n_contacts = 0
    with CellTable.create(LEAST_BUDGET) as table:
        frames = ResidentFrames(Residency(env.store, table), shell, Penalty())
        felt = frames.evaluate(poses())
        frames.close()
    for n, pose in enumerate(poses()):
        wanted = expected(shell, pose)
        wrench = np.array([*wanted.force, *wanted.torque])
        for strategy in ("auto", "array", "points", "maxgap"):
            touch = env.touch(shell, pose, strategy, law=Penalty())
            assert touch.hits.tolist() == touch.contacts.tolist() == wanted.hits
            assert touch.depths.tolist() == wanted.depths
            assert np.array_equal([*touch.force, *touch.torque], wrench)
        assert np.array_equal(felt.wrenches[n], wrench)
        assert felt.hits[n] == felt.contacts[n] == len(wanted.hits)
        n_contacts += len(wanted.hits)
    assert n_contacts > 0
    with pytest.raises(ValueError, match="this law is off"):
        env.touch(shell, poses()[0], law=Penalty(is_on=False))
