"""The distance law on rows and on resident cells, against plain Python and closed forms."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bands import BandRows, band_rows
from hapticdb import Grid, PointShell
from hapticdb.grid import CurveName
from hapticdb.kernels.field import distance_law as field
from hapticdb.kernels.field.lattice import BEYOND, CELL_SIDE, CELL_VALUES, HALF_WIDTH, STEPS
from hapticdb.kernels.query import refining
from hapticdb.kernels.records.cells import CONTROL, MISSED, READER
from hapticdb.kernels.records.hand import RESULT
from hapticdb.kernels.resident import cells as resident
from hapticdb.kernels.resident.cell_frames import evaluate_frames
from hapticdb.kernels.resident.near_voxels import mark_near_voxels
from hapticdb.query.haptic_query import locate
from hapticdb.resident.point_runs import clusters_of
from naive_frame import NaiveTouch, distance_at, touch_distances
from session import worlds

ORIGIN = (-0.31, 0.17, -0.05)
SIZE = 0.013
BITS = 6
Array = NDArray[np.float64]


def random_triangles(seed: int, center: tuple[float, float, float], n: int = 12) -> Array:
    """Loose triangles, n of them, within some 10 voxels of a place, metres."""
    rng = np.random.default_rng(seed)
    middles = np.array(center) + rng.normal(size=(n, 1, 3)) * 4
    return np.array(ORIGIN) + SIZE * (middles + rng.normal(size=(n, 3, 3)) * 4)


def is_inside(triangles: Array) -> NDArray[np.bool_]:
    """Which triangles lie in the grid."""
    placed = (triangles - np.array(ORIGIN)) / SIZE
    return ((placed >= 0) & (placed <= 1 << BITS)).all(axis=(1, 2))  # type: ignore[no-any-return]


PLACES = ((20, 20, 20), (26, 22, 20), (30, 34, 33), (59, 60, 58), (3, 4, 3))


def grid_of(curve: CurveName = "z") -> Grid:
    return Grid(SIZE, ORIGIN, BITS, curve)


@cache
def objects(curve: CurveName = "z") -> list[BandRows]:
    """Five objects; some share voxels, and two lie at the grid's border."""
    found = []
    for n, place in enumerate(PLACES):
        triangles = random_triangles(n, place)
        found.append(band_rows(triangles[is_inside(triangles)], grid_of(curve)))
    return found


class Merged:
    """Rows of several objects, as a store gives them."""

    def __init__(self, parts: list[BandRows]) -> None:
        self.parts = parts
        keys = np.concatenate([part.keys for part in parts])
        ids = np.concatenate([np.full(len(p.keys), n + 1) for n, p in enumerate(parts)])
        order = np.lexsort((ids, keys))
        self.keys, self.ids = keys[order], ids[order]
        bits = np.concatenate([part.occupancy.reshape(-1, 64) for part in parts])
        self.occupancy = np.frombuffer(bits[order].tobytes(), dtype=np.uint8)
        self.values = np.concatenate([part.values for part in parts])[order]
        self.fields = {n + 1: part.steps for n, part in enumerate(parts)}
        self.ids_in: dict[tuple[int, int, int], set[int]] = {}
        for n, part in enumerate(parts):
            for i, j, k in part.voxels.tolist():
                self.ids_in.setdefault((i, j, k), set()).add(n + 1)


@cache
def merged(curve: CurveName = "z") -> Merged:
    return Merged(objects(curve))


def random_shell(seed: int, n_points: int, reach: float = 12.0) -> PointShell:
    return worlds.random_shell(seed, n_points, reach, SIZE)


def random_pose(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    pose = worlds.turned(rng, np.zeros(3))
    place = np.array(PLACES[rng.integers(len(PLACES))]) + rng.normal(size=3) * 3
    pose[:3, 3] = np.array(ORIGIN) + SIZE * place
    return pose


def expected(scene: Merged, shell: PointShell, pose: Array, exclude: list[int]) -> NaiveTouch:
    x, y, z = shell.center.tolist()
    return touch_distances(
        scene.ids_in,
        scene.fields,
        [(a, b, c) for a, b, c in shell.points.tolist()],
        [(a, b, c) for a, b, c in shell.normals.tolist()],
        (x, y, z),
        pose.tolist(),
        ORIGIN,
        SIZE,
        1 << BITS,
        exclude=exclude,
    )


LAW = field.DistanceFieldLaw(1000.0)


class Felt(NamedTuple):
    """What `refining.refine` finds: of the hits, and of points that are felt apart from them."""

    wrench: Array
    hits: NDArray[np.int64]
    depths: Array
    ids: NDArray[np.int64]
    apart: NDArray[np.int64]
    apart_depths: Array


def on_rows(
    scene: Merged, grid: Grid, shell: PointShell, pose: Array, exclude: list[int]
) -> tuple[Felt, NDArray[np.int64]]:
    """A frame on rows, and the pairs of its contacts and the objects that they touch."""
    excluded = np.array(sorted(set(exclude)), dtype=np.int64)
    record = grid.for_kernels(9)
    located = locate(shell, pose, record)
    rows = (scene.keys, scene.ids, scene.occupancy, scene.values, excluded, record, LAW)
    total = len(shell)
    out, met = np.empty(6 + 2 * total), np.empty(2 * total + len(scene.ids), dtype=np.int64)
    hits, apart, ids = refining.refine(*located, *rows, out, met)
    felt = Felt(
        out[:6], met[:hits], out[6 : 6 + hits], met[2 * total : 2 * total + ids],
        met[total : total + apart], out[6 + total : 6 + total + apart],
    )  # fmt: skip
    contacts = np.sort(np.concatenate([felt.hits[felt.depths > 0], felt.apart]))
    return felt, refining.pairs_of_points(*located, *rows, contacts)


@cache
def cells_of(scene: Merged, exclude: tuple[int, ...]) -> resident.Cells:
    """All cells of the grid in memory."""
    side = (1 << BITS) >> 5
    least = np.full((side * 32 + 2,) * 3, BEYOND, dtype=np.uint8)
    is_full = np.zeros((side * 32,) * 3, dtype=bool)
    has_row = np.zeros((side * 4,) * 3, dtype=bool)
    for n, part in enumerate(scene.parts):
        if n + 1 not in exclude:
            places, q = np.array(list(part.steps)) + 1, np.array(list(part.steps.values()))
            is_near = ((places >= 0) & (places < len(least))).all(axis=1)
            np.minimum.at(least, tuple(places[is_near].T), q[is_near].astype(np.uint8))
            is_full[tuple(part.voxels.T)] = True
    for brick in np.ndindex(has_row.shape):
        i, j, k = 8 * np.array(brick)
        has_row[brick] = (least[i : i + 10, j : j + 10, k : k + 10] != BEYOND).any()
    n_cells = side**3
    keys, slots = np.full((3, 64), -1, dtype=np.int64), np.zeros((3, 64), dtype=np.int32)
    words = np.zeros((1 + n_cells, resident.CELL_WORDS), dtype=np.uint32)
    masks = np.zeros(1 + n_cells, dtype=np.uint64)
    payload = np.full((1 + n_cells, CELL_VALUES), BEYOND, dtype=np.uint8)
    for n, cell in enumerate(np.ndindex((side,) * 3)):
        i, j, k = 32 * np.array(cell)
        full = is_full[i : i + 32, j : j + 32, k : k + 32]
        words[1 + n] = (full.astype(np.uint64) << np.arange(32, dtype=np.uint64)).sum(-1).ravel()
        payload[1 + n] = least[i : i + CELL_SIDE, j : j + CELL_SIDE, k : k + CELL_SIDE].ravel()
        bricks = has_row[i // 8 : i // 8 + 4, j // 8 : j // 8 + 4, k // 8 : k // 8 + 4]
        masks[1 + n] = sum(1 << b for b in np.flatnonzero(bricks.ravel()).tolist())
        key = resident.key_of_cell(*cell)
        at = resident.place_in_set(keys[0], key)
        keys[:, at], slots[:, at] = key, 1 + n
    near = np.zeros_like(words)
    mark_near_voxels(np.arange(1, 1 + n_cells), payload, masks, words, near)
    return resident.Cells(
        np.ones((), CONTROL), np.zeros(16, READER), keys, slots, words, masks,
        np.zeros(1 + n_cells, dtype=np.uint8), payload, near,
    )  # fmt: skip


def on_cells(
    cells: resident.Cells, shell: PointShell, pose: Array, run: int | None
) -> NDArray[np.void]:
    """RESULT of a frame on resident cells."""
    out, met = np.zeros(1, RESULT), np.empty(len(shell), dtype=np.int64)
    place = resident.CellGrid(*ORIGIN, SIZE, float(1 << BITS))
    clusters = clusters_of(shell, SIZE, run)
    missed = np.zeros((), MISSED)
    evaluate_frames(cells, 0, clusters, pose[None], place, LAW, met, missed, out)
    return out[0]  # type: ignore[no-any-return]


few = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.parametrize("curve", ["z", "hilbert"])
@few
@given(
    seed=st.integers(0, 2**32 - 1),
    n_points=st.sampled_from([1, 2, 9, 40, 300]),
    exclude=st.lists(st.integers(1, 5), max_size=3),
)
def test_distance_law_rows_and_cells_equal_plain_python(
    curve: CurveName, seed: int, n_points: int, exclude: list[int]
) -> None:
    scene, shell, pose = merged(curve), random_shell(seed, n_points), random_pose(seed)
    wanted = expected(scene, shell, pose, exclude)
    felt, pairs = on_rows(scene, grid_of(curve), shell, pose, exclude)
    wrench, hits, depths, ids, apart, apart_depths = felt
    assert wrench.tolist() == [*wanted.force, *wanted.torque]
    assert hits.tolist() == wanted.hits
    assert depths.tolist() == wanted.depths
    assert ids.tolist() == wanted.ids
    assert apart.tolist() == wanted.apart
    assert apart_depths.tolist() == wanted.apart_depths
    assert [tuple(pair) for pair in pairs.tolist()] == wanted.near
    cells = cells_of(scene, tuple(sorted(set(exclude)))) if curve == "z" else None
    for run in (0, 4, 64):
        if cells is not None:
            result = on_cells(cells, shell, pose, run)
            assert result["wrench"].tolist() == wrench.tolist()
            assert result["hits"] == len(hits)
            assert result["contacts"] == len(wanted.contacts)
            assert result["deepest"] == max(wanted.contact_depths.values(), default=0.0)


def test_distance_law_scene_covers_all_cases() -> None:
    """Else the property test would prove little."""
    scene = merged()
    found = [expected(scene, random_shell(s, 300), random_pose(s), []) for s in range(20)]
    assert max(len(f.ids) for f in found) >= 3
    assert any(f.apart and f.hits for f in found)
    assert any(10 <= len(f.contacts) < 200 for f in found)
    assert any(d > 0 for f in found for d in f.apart_depths)


# --- the distance from which on nothing is felt --------------------------------------------------


def least_distance_at(where: Array, true_distance: float) -> float:
    """The least u that a distance field can have at a point that far from every surface."""
    low = np.floor(where - 0.5)
    part = where - 0.5 - low
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        gap = float(np.linalg.norm(low + 0.5 + corner - where))
        least = max(true_distance - gap, 0.0)
        steps = STEPS
        if least <= HALF_WIDTH:
            steps = int(np.floor(least * STEPS / HALF_WIDTH + 0.5))
        weights = [f if c else 1.0 - f for c, f in zip(corner, part, strict=True)]
        total += float(np.prod(weights)) * steps * HALF_WIDTH / STEPS
    return total


def test_distance_law_range_within_stored_band() -> None:
    """The field that is least at all 8 centres at once, at points all over a voxel's corner."""
    shares = np.linspace(0.0, 1.0, 11)
    places = np.stack(np.meshgrid(shares, shares, shares), axis=-1).reshape(-1, 3) + 10.5
    least = min(least_distance_at(place, field.FORCE_RANGE) for place in places)
    assert least > field.REACH
    assert field.FORCE_RANGE < HALF_WIDTH + 3.0**0.5
    # the bound is not much larger than it must be
    close = min(least_distance_at(place, field.FORCE_RANGE - 0.2) for place in places)
    assert close < field.REACH


# --- closed forms --------------------------------------------------------------------------------

PLANE_AT = 20.0


@cache
def sheet() -> Merged:
    """A square in the plane z = 20 voxels."""
    corners = np.array([[8.0, 8, 0], [56, 8, 0], [56, 56, 0], [8, 56, 0]])
    corners[:, 2] = PLANE_AT
    square = np.array([corners[[0, 1, 2]], corners[[0, 2, 3]]])
    return Merged([band_rows(np.array(ORIGIN) + SIZE * square, grid_of())])


def frame(scene: Merged, points: Array, normals: Array) -> Array:
    """Wrench (6,) of points (N, 3), voxels from the origin, about the first one's place."""
    placed = np.array(ORIGIN) + SIZE * points
    shell = PointShell(points=placed, normals=normals, center=placed[0])
    return on_rows(scene, grid_of(), shell, np.eye(4), [])[0][0]


UP = np.array([[0.0, 0.0, 1.0]])


@given(u=st.floats(0.7, 2.7), x=st.floats(20.0, 40.0), y=st.floats(20.0, 40.0))
@few
def test_distance_law_point_over_plane(u: float, x: float, y: float) -> None:
    """F = K s (delta - u), averaged by nobody, to the accuracy of trilinear distances."""
    felt = frame(sheet(), np.array([[x, y, PLANE_AT + u]]), UP)
    assert felt[2] == pytest.approx(1000.0 * SIZE * max(1.5 - u, 0.0), abs=1000.0 * SIZE * 0.03)
    assert felt[0] == felt[1] == 0.0
    if u > 1.53:
        assert not felt.any()


@pytest.mark.parametrize("n_points", [4, 9, 10, 100])
def test_distance_law_punch_averaged_from_ten_points(n_points: int) -> None:
    """All points at u = 1: each counts fully, and pushes K s (delta - 1)."""
    side = int(np.ceil(np.sqrt(n_points)))
    xy = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:n_points]
    points = np.column_stack([20.3 + 0.7 * xy, np.full(n_points, PLANE_AT + 1.0)])
    felt = frame(sheet(), points, np.repeat(UP, n_points, axis=0))
    one = frame(sheet(), points[:1], UP)[2]
    assert one == pytest.approx(1000.0 * SIZE * 0.5, rel=0.02)
    assert felt[2] == pytest.approx(one * n_points / max(1.0, n_points / 10), rel=0.02)


def test_distance_law_coincident_objects_push_once() -> None:
    one = band_rows(np.array(ORIGIN) + SIZE * np.array([[[9.0, 9, 20], [40, 9, 20], [9, 40, 20]]]),
                    grid_of())  # fmt: skip
    shell = PointShell(
        points=np.array(ORIGIN) + SIZE * np.array([[15.3, 15.4, 21.1]]), normals=UP,
        center=np.zeros(3),
    )  # fmt: skip
    alone, _ = on_rows(Merged([one]), grid_of(), shell, np.eye(4), [])
    twice, pairs = on_rows(Merged([one, one]), grid_of(), shell, np.eye(4), [])
    assert alone[0].any()
    assert twice[0].tolist() == alone[0].tolist()
    assert (alone[3].tolist(), twice[3].tolist()) == ([1], [1, 2])
    assert pairs.tolist() == [[0, 1], [0, 2]]
    assert not twice[1].size, "the point is no hit"


def test_distance_law_nearest_object_reported() -> None:
    """In a corner of two sheets the least distances interpolate lower than each of them."""
    floor = np.array([[[9.0, 9, 20], [50, 9, 20], [9, 50, 20]]])
    wall = np.array([[[20.0, 9, 9], [20, 50, 9], [20, 9, 50]]])
    parts = [band_rows(np.array(ORIGIN) + SIZE * part, grid_of()) for part in (floor, wall)]
    scene = Merged(parts)
    rng = np.random.default_rng(0)
    away = rng.uniform(1.4, 1.6, (2000, 1))
    points = np.column_stack([20 + away, np.full(2000, 18.7), 20 + away])
    points[:, 0] += rng.uniform(-0.02, 0.02, 2000)
    normals = np.repeat(UP, 2000, axis=0)
    shell = PointShell(np.array(ORIGIN) + SIZE * points, normals, np.zeros(3))
    felt, pairs = on_rows(scene, grid_of(), shell, np.eye(4), [])
    own = [
        [distance_at((x, y, z), [steps]) for steps in scene.fields.values()]
        for x, y, z in points.tolist()
    ]
    between = [n for n in felt.apart.tolist() if min(own[n]) >= 1.5]
    assert between, "no point lies between"
    assert sorted(set(pairs[:, 0].tolist())) == felt.apart.tolist()
    for n in between:
        named = pairs[pairs[:, 0] == n, 1].tolist()
        assert len(named) == 1
        assert own[n][named[0] - 1] == min(own[n])
