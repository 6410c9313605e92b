"""A law from outside the package: a plain penalty on occupancy, through frames of both kinds.

No kernel knows it. `hapticdb.kernels.law.define` enters its functions, and the kernels are compiled
once more for its type.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.kernels import law as kernels
from hapticdb.kernels.query import contact, refining
from hapticdb.kernels.records import RESULTS
from hapticdb.kernels.resident.cells import CONTACTS, HITS
from hapticdb.kernels.resident.feeling import feel_kernel
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.testing import blob, write_voxels
from naive_frame import NaiveTouch
from naive_frame import touch as naive_touch

ORIGIN = (-0.31, 0.17, -0.05)
SIZE = 0.013
BITS = 6
STIFFNESS = 750.0
Array = NDArray[np.float64]


class PenaltyNumbers(NamedTuple):
    """A plain penalty as kernels take it."""

    stiffness: float


def penalty(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """Every hit is felt half a voxel deep."""
    return 0.5 * size, 1.0


kernels.define(PenaltyNumbers, kernels.Leaves(respond=penalty))


class NearNumbers(NamedTuple):
    """A law that feels what its payload says, hit or not."""

    stiffness: float


def sample_rows(law, payload, counts, first, end, x, y, z):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """Least distance that the payload has for a whole row, voxels."""
    least = np.inf
    for row in range(first, end):
        if counts[row]:
            least = min(least, float(payload[row, 0]))
    return least


def sample_slot(law, payload, slot, x, y, z):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """Distance that the payload has for a whole slot, voxels."""
    return float(payload[slot, 0])


def reach(law):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """One voxel."""
    return 1.0


def felt_within(law):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """Anywhere in a brick that holds a voxel: as far as its corners are from one another."""
    return 8.0 * 3.0**0.5


kernels.define(
    NearNumbers,
    kernels.Leaves(
        penalty,
        reach=reach,
        felt_within=felt_within,
        sample_rows=sample_rows,
        sample_slot=sample_slot,
    ),
)


class Penalty:
    """A plain penalty on occupancy, as `Environment.touch` takes a law."""

    stiffness = STIFFNESS
    for_kernels = PenaltyNumbers(STIFFNESS)


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    env = hapticdb.create(tmp_path / "e.db", Grid(SIZE, ORIGIN, BITS))
    for seed, center in ((1, (20, 20, 20)), (2, (26, 22, 20))):
        write_voxels(env.store, blob(seed, center), f"blob {seed}")
    return env


def shell_of(n_points: int) -> PointShell:
    rng = np.random.default_rng(n_points)
    normals = rng.normal(size=(n_points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.uniform(-8, 8, (n_points, 3)) * SIZE
    return PointShell(points=points, normals=normals, center=rng.normal(size=3) * SIZE)


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
    x, y, z = shell.center.tolist()
    points = [(a, b, c) for a, b, c in shell.points.tolist()]
    normals = [(a, b, c) for a, b, c in shell.normals.tolist()]
    return naive_touch(
        plain, points, normals, (x, y, z), pose.tolist(), ORIGIN, SIZE, 1 << BITS, STIFFNESS,
        depth_of=lambda _p, _n, _c, size: 0.5 * size,
    )  # fmt: skip


def test_frames_of_both_kinds_feel_a_law_that_no_kernel_knows(env: Environment) -> None:
    shell = shell_of(300)
    n_felt = 0
    with CellTable.create(LEAST_BUDGET) as table:
        frames = ResidentFrames(Residency(env.store, table), shell, Penalty())
        felt = frames.feel(poses())
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
        n_felt += len(wanted.hits)
    assert n_felt > 0


@pytest.mark.long
def test_a_payload_lets_a_law_feel_points_that_are_no_hits(env: Environment) -> None:
    """A payload of zeros: everything in a brick that holds a voxel is felt, and hits stay hits."""
    shell, pose, law = shell_of(300), poses()[0], NearNumbers(STIFFNESS)
    grid = env.grid
    located = contact.locate(
        shell.points, shell.normals, shell.center, pose, np.array(grid.origin), SIZE, BITS,
        grid.curve_code, 9,
    )  # fmt: skip
    rows = env.store.lookup(located.keys)
    nothing = np.empty(0, dtype=np.int64)
    origin = np.array(grid.origin)

    def refined(payload: NDArray[np.uint8]) -> refining.Refined:
        return refining.refine(*located, *rows[:3], payload, nothing, origin, SIZE, law)

    wrench, hits, _, _, apart, depths = refined(np.zeros((len(rows), 1), dtype=np.uint8))
    wanted = expected(shell, pose)
    is_near = np.isin(located.keys[located.asked[1]], rows.keys) & (located.asked[1] >= 0)
    assert hits.tolist() == wanted.hits
    assert sorted([*hits.tolist(), *apart.tolist()]) == np.flatnonzero(is_near).tolist()
    assert len(apart) > 0
    assert (depths == 0.5 * SIZE).all()
    with CellTable.create(LEAST_BUDGET) as table:
        frames = ResidentFrames(Residency(env.store, table), shell, Penalty())
        frames.feel(pose[None])
        cells = table.cells._replace(payload=np.zeros((table.n_slots, 1), dtype=np.uint8))
        out = np.zeros((1, RESULTS))
        place, met = frames.residency.place, np.empty(300, dtype=np.int64)
        with table.reading() as reader:
            feel_kernel(
                cells, reader, frames.clusters, pose[None], place, law, met, frames.missed, out
            )
        frames.close()
    assert out[0, :6].tolist() == wrench.tolist()
    assert met[: int(out[0, HITS])].tolist() == wanted.hits
    assert out[0, CONTACTS] == is_near.sum()
    far = refined(np.full((len(rows), 1), 2, dtype=np.uint8))
    assert far[1].tolist() == wanted.hits
    assert far[4].size == 0
    assert far[0].tolist() == [*wanted.force, *wanted.torque]
