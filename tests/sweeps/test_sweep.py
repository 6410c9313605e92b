"""Sweeps of a path, against plain Python: samples, hits, objects, clearance."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.errors import GeometryChangedError, ObjectNotFoundError, UsageError
from hapticdb.pointshell.shell import fibonacci_sphere
from hapticdb.poses import rotation_of
from hapticdb.resident.table import LEAST_BUDGET, slots_within
from hapticdb.store.base import Layout
from hapticdb.sweeps import run as sweeping
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.result import Swept
from hapticdb.sweeps.run import sweep
from hapticdb.testing import write_voxels
from naive_frame import NaiveTouch, touch

Floats = NDArray[np.float64]
Voxels = NDArray[np.int64]

SIZE = 0.01
GRID = Grid(SIZE, (-0.2, 0.1, 0.3), 7)
MIDDLE = np.array(GRID.origin) + 0.5 * GRID.edge
KINDS: list[tuple[Layout, str]] = [("brick", "hilbert"), ("voxel", "z")]

numbers = st.floats(-1.0, 1.0, allow_nan=False, width=32)
triples = st.tuples(numbers, numbers, numbers)
quadruples = st.tuples(numbers, numbers, numbers, numbers).filter(
    lambda q: sum(x * x for x in q) > 0.01
)
turned = st.tuples(triples, quadruples)


def pose_of(place: Any, quaternion: Any = (1, 0, 0, 0)) -> Floats:  # noqa: ANN401 - any triple
    pose = np.eye(4)
    unit = np.asarray(quaternion, dtype=float)
    pose[:3, :3] = rotation_of(unit / np.linalg.norm(unit))[0]
    pose[:3, 3] = place
    return pose


def line(*places: Any) -> Floats:  # noqa: ANN401
    return np.array([pose_of(MIDDLE + np.asarray(place)) for place in places])


def ball(n_points: int = 24, radius: float = 0.024) -> PointShell:
    out = fibonacci_sphere(n_points)
    return PointShell(out * radius, -out, np.zeros(3))


def block(low: Any, high: Any) -> Voxels:  # noqa: ANN401
    """Voxels (n, 3) from `low` to `high`, `high` excluded."""
    axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


# a wall with a hole across the path, a plate above, and a post that shares voxels with the wall
WALL = np.array(
    [v for v in block((80, 40, 40), (82, 90, 90)) if not (60 <= v[1] < 68 and 60 <= v[2] < 68)]
)
PLATE = block((20, 50, 90), (60, 80, 91))
POST = block((81, 50, 50), (84, 54, 54))


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def env(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    layout, curve = request.param
    url = tmp_path_factory.mktemp("swept") / "scene.db"
    with hapticdb.create(url, replace(GRID, curve=curve), layout=layout) as made:
        for ijk, name in ((WALL, "wall"), (PLATE, "plate"), (POST, "post")):
            write_voxels(made.store, ijk, name)
        yield made


IDS_IN: dict[tuple[int, int, int], list[int]] = {}
for number, voxels in enumerate((WALL, PLATE, POST), 1):
    for i, j, k in voxels.tolist():
        IDS_IN.setdefault((i, j, k), []).append(number)


def naive(shell: PointShell, pose: Floats, exclude: tuple[int, ...] = ()) -> NaiveTouch:
    points: Any = shell.points.tolist()
    normals: Any = shell.normals.tolist()
    center: Any = shell.center.tolist()
    return touch(
        IDS_IN, points, normals, center, pose.tolist(), GRID.origin, SIZE, GRID.side,
        exclude=exclude,
    )  # fmt: skip


def naive_clearance(shell: PointShell, poses: Floats, exclude: tuple[int, ...] = ()) -> float:
    """Least distance in metres of any point at any pose to the cube of any occupied voxel."""
    voxels = [v for v, ids in IDS_IN.items() if set(ids) - set(exclude)]
    low = np.array(GRID.origin) + SIZE * np.array(voxels, dtype=float)
    least = np.inf
    for pose in poses:
        for point in shell.points @ pose[:3, :3].T + pose[:3, 3]:
            outside = np.maximum(np.maximum(low - point, point - (low + SIZE)), 0.0)
            least = min(least, float(np.sqrt((outside**2).sum(axis=1)).min()))
    return least


def samples_of(found: Swept) -> Floats:
    return found.path.sample(0, found.samples)


# --- the path ------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    poses=st.lists(turned, min_size=1, max_size=4),
    points=st.lists(triples, min_size=1, max_size=6),
    offset=triples,
    size=st.sampled_from([0.05, 0.3, 4.0]),
)
def test_no_point_moves_more_than_half_a_voxel_between_samples(
    poses: list[Any], points: list[Any], offset: tuple[float, ...], size: float
) -> None:
    inward = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    shell = PointShell(np.array(points) + 10.0 * np.array(offset), inward, np.zeros(3))
    given_poses = np.array([pose_of(*pose) for pose in poses])
    path = SweepPath.of(given_poses, shell, size)
    samples = path.sample(0, len(path))
    placed = np.einsum("nab,pb->npa", samples[:, :3, :3], shell.points) + samples[:, None, :3, 3]
    moved = np.linalg.norm(np.diff(placed, axis=0), axis=2)
    assert moved.max(initial=0.0) <= 0.5 * size * (1 + 1e-9)
    assert np.array_equal(samples[path.starts], given_poses)
    travels = np.diff(path.travels(0, len(path))) * size
    assert (moved.max(axis=1, initial=0.0) <= travels + 1e-12).all()


def test_fractions_go_by_the_way_and_not_by_the_number_of_poses() -> None:
    path = SweepPath.of(line((0, 0, 0), (0.001, 0, 0), (0.101, 0, 0)), ball(), SIZE)
    assert path.fractions(path.starts) == pytest.approx([0.0, 0.001 / 0.101, 1.0])
    assert path.segments([0, int(path.starts[1]), len(path) - 1]).tolist() == [0, 1, 1]


# --- hits ----------------------------------------------------------------------------------------

PATHS = st.lists(
    st.tuples(st.tuples(*[st.floats(-0.3, 0.3)] * 3), quadruples), min_size=1, max_size=3
)
SLOW = settings(
    max_examples=6,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@SLOW
@given(poses=PATHS, exclude=st.sampled_from([(), (1,), (2, 3)]))
def test_hits_contacts_and_objects_are_those_of_every_sample(
    env: Environment, poses: list[Any], exclude: tuple[int, ...]
) -> None:
    shell = ball()
    given_poses = np.array([pose_of(MIDDLE + np.array(p), q) for p, q in poses])
    found = sweep(env, shell, given_poses, exclude=exclude, clearance_limit=0)
    frames = [naive(shell, pose, exclude) for pose in samples_of(found)]
    assert found.hits == sum(bool(frame.hits) for frame in frames)
    assert found.contacts == sum(bool(frame.contacts) for frame in frames)
    first = next((n for n, frame in enumerate(frames) if frame.hits), None)
    assert (found.first_hit.sample if found.first_hit else None) == first
    if found.first_hit is not None and first is not None:
        assert [obj.id for obj in found.first_hit.objects] == frames[first].ids
        assert np.array_equal(found.first_hit.pose, samples_of(found)[first])
    touched = next((n for n, frame in enumerate(frames) if frame.contacts), None)
    assert (found.first_contact.sample if found.first_contact else None) == touched
    if found.first_contact is not None and touched is not None:
        ids = {i for n, i in frames[touched].pairs if n in frames[touched].contacts}
        assert [obj.id for obj in found.first_contact.objects] == sorted(ids)
    depth = max((max(frame.depths, default=0.0) for frame in frames), default=0.0)
    assert (found.deepest.depth if found.deepest else 0.0) == depth
    met = {one.object.id: one for one in found.objects}
    assert set(met) == {i for frame in frames for i in frame.ids}
    for i, one in met.items():
        at = [n for n, frame in enumerate(frames) if i in frame.ids]
        assert one.samples == len(at)
        assert [one.first, one.last] == found.path.fractions([at[0], at[-1]]).tolist()
        depths = [
            frame.depths[frame.hits.index(n)] for frame in frames for n, j in frame.pairs if j == i
        ]
        assert one.deepest == max(depths)
        points = [sum(j == i for _, j in frame.pairs) for frame in frames]
        assert one.points == max(points)


def test_hits_near_one_another_are_one_interval(env: Environment) -> None:
    """The tool passes through the wall twice, there and back; each pass is one interval."""
    far = 0.3
    found = sweep(env, ball(), line((0, -0.1, 0), (far, -0.1, 0), (0, -0.1, 0)))
    hits = [bool(naive(ball(), pose).hits) for pose in samples_of(found)]
    runs = [
        list(run) for is_hit, run in itertools.groupby(range(len(hits)), hits.__getitem__) if is_hit
    ]
    assert len(runs) >= 2
    assert len(found.hit_intervals) == 2
    assert found.hit_intervals[0, 0] == found.path.fractions(runs[0][0])
    assert found.hit_intervals[-1, 1] == found.path.fractions(runs[-1][-1])


# --- clearance -----------------------------------------------------------------------------------


@SLOW
@given(poses=PATHS, exclude=st.sampled_from([(), (1, 3)]))
def test_clearance_is_the_least_distance_of_any_point_to_any_voxel(
    env: Environment, poses: list[Any], exclude: tuple[int, ...]
) -> None:
    shell = ball(8)
    given_poses = np.array([pose_of(MIDDLE + np.array(p), q) for p, q in poses])
    limit = 0.2
    found = sweep(env, shell, given_poses, exclude=exclude, clearance_limit=limit)
    expected = naive_clearance(shell, samples_of(found), exclude)
    clearance = found.clearance
    assert clearance is not None
    assert clearance.is_beyond == (expected >= limit)
    if clearance.is_beyond:
        assert (clearance.distance, clearance.moment) == (limit, None)
        return
    assert clearance.distance == pytest.approx(expected, abs=1e-9)
    assert (clearance.distance == 0.0) == (found.verdict == "hits")
    if not found.hits:
        assert clearance.moment is not None
        assert clearance.point is not None
        assert clearance.voxel is not None
        outside = np.maximum(np.abs(clearance.point - clearance.voxel) - 0.5 * SIZE, 0.0)
        assert np.linalg.norm(outside) == pytest.approx(clearance.distance, abs=1e-9)
        voxel = tuple(GRID.voxels_of(clearance.voxel[None])[0].tolist())
        ids = [i for i in IDS_IN[voxel] if i not in exclude]
        assert [obj.id for obj in clearance.moment.objects] == ids


def test_clearance_along_the_path_is_that_of_the_samples_there(env: Environment) -> None:
    shell = ball(12)
    found = sweep(env, shell, line((-0.2, 0, 0), (0.05, 0, 0)), clearance_limit=0.15, profile=True)
    profile = found.profile
    assert len(profile.fractions) == found.samples < sweeping.WINDOWS
    each = [min(naive_clearance(shell, pose[None]), 0.15) for pose in samples_of(found)]
    assert profile.clearances == pytest.approx(each, abs=1e-9)
    assert found.clearance is not None
    assert found.clearance.distance == pytest.approx(min(each), abs=1e-9)


def test_clearance_that_is_not_asked_for_is_not_given(env: Environment) -> None:
    found = sweep(env, ball(), line((0, 0, 0)), clearance_limit=0)
    assert found.clearance is None
    assert np.isnan(found.profile.clearances).all()


def test_clearance_says_what_it_means_for_surfaces(env: Environment) -> None:
    """1.5 voxels from the wall's voxels; the surface lies at most a voxel's diagonal deeper."""
    shell = PointShell(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), np.zeros(3), cover=0.002)
    place = env.grid.centers([[78, 60, 50]])[0]
    aside = place - (0.0, 0.25 * SIZE, 0.0)
    for poses, off in (([pose_of(place)], 0.0), ([pose_of(place), pose_of(aside)], 0.125 * SIZE)):
        found = sweep(env, shell, poses)
        assert found.proof.off == pytest.approx(off, abs=1e-6 * SIZE)
        assert found.clearance is not None
        assert found.clearance.distance == pytest.approx(1.5 * SIZE)
        assert found.clearance.at_least == pytest.approx(1.5 * SIZE - off - 0.002, abs=1e-6 * SIZE)
        assert found.clearance.at_most == pytest.approx((1.5 + 3**0.5) * SIZE)


def test_beside_the_grid_nothing_is_hit_and_the_border_counts(env: Environment) -> None:
    shell = ball(12)
    poses = np.array([pose_of(np.array(GRID.origin) - 1.0), pose_of(np.array(GRID.origin) - 0.9)])
    found = sweep(env, shell, poses)
    assert found.hits == 0
    assert found.clearance is not None
    assert found.clearance.is_beyond


# --- memory, revisions, wrong use ----------------------------------------------------------------


def test_the_least_budget_finds_the_same(tmp_path: Path) -> None:
    """The grid has many cells, and the cell table holds few of them."""
    grid = Grid(0.002, (0.0, 0.0, 0.0), 10)
    spots = np.random.default_rng(3).integers(0, 1024, (4000, 3))
    shell = ball(60, 0.05)
    poses = [pose_of((0.3, 0.3, 0.3)), pose_of((1.7, 1.5, 1.2), (1, 1, 0, 0))]
    with hapticdb.create(tmp_path / "spots.db", grid) as env:
        write_voxels(env.store, np.unique(spots, axis=0), "spots")
        large = sweep(env, shell, poses, clearance_limit=0.05, profile=True)
        small = sweep(
            env, shell, poses, clearance_limit=0.05, profile=True, budget_bytes=LEAST_BUDGET
        )
    assert small.cells > 2 * slots_within(LEAST_BUDGET)  # so cells have made room for others
    assert (small.hits, small.contacts) == (large.hits, large.contacts)
    assert np.array_equal(small.profile.clearances, large.profile.clearances)
    for one, same in zip(small.objects, large.objects, strict=True):
        assert (one.samples, one.contacts, one.points) == (same.samples, same.contacts, same.points)
        assert np.array_equal(one.intervals, same.intervals)
        assert (one.deepest, one.length) == (same.deepest, same.length)


def test_a_sweep_sees_one_revision_while_others_write(tmp_path: Path, monkeypatch: Any) -> None:  # noqa: ANN401
    monkeypatch.setattr(sweeping, "BLOCK", 8)
    poses = line((-0.3, 0, 0), (0.3, 0, 0))
    url = tmp_path / "scene.db"
    with hapticdb.create(url, GRID) as env, hapticdb.open(url) as other:
        write_voxels(env.store, PLATE, "plate")
        before = sweep(env, ball(), poses)

        def obstruct(done: int, total: int) -> None:
            if done < total:
                write_voxels(
                    other.store, block((90, 50, 50), (92, 80, 80 + done % 2)), f"wall{done}"
                )

        meanwhile = sweep(env, ball(), poses, progress=obstruct)
        after = sweep(env, ball(), poses)
    assert before.hits == 0
    assert (meanwhile.hits, meanwhile.revision) == (0, before.revision)
    assert after.verdict == "hits"
    assert after.revision > before.revision


def test_progress_is_told_after_each_block(env: Environment, monkeypatch: Any) -> None:  # noqa: ANN401
    monkeypatch.setattr(sweeping, "BLOCK", 10)
    told: list[tuple[int, int]] = []
    found = sweep(env, ball(), line((0, 0, 0), (0.1, 0, 0)), progress=lambda *now: told.append(now))
    assert told[-1] == (found.samples, found.samples)
    assert [done for done, _ in told[:-1]] == list(range(10, found.samples, 10))


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (np.eye(4), "shape"),
        (np.empty((0, 4, 4)), "shape"),
        (np.full((1, 4, 4), np.nan), "pose 0"),
        (np.array([np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])]), "pose 1"),
        ("abc", "numbers"),
    ],
)
def test_a_path_that_is_none_is_refused(env: Environment, poses: Any, words: str) -> None:  # noqa: ANN401
    with pytest.raises(UsageError, match=words):
        sweep(env, ball(), poses)


def test_wrong_use_is_refused(env: Environment, tmp_path: Path) -> None:
    poses = line((0, 0, 0))
    with pytest.raises(ObjectNotFoundError, match="no object 77"):
        sweep(env, ball(), poses, exclude=[77])
    with pytest.raises(UsageError, match="finite length"):
        sweep(env, ball(), poses, clearance_limit=-1.0)
    with pytest.raises(UsageError, match="larger budget"):
        sweep(env, ball(), poses, clearance_limit=1.0, budget_bytes=1 << 20)
    grid = replace(GRID, curve="lexicographic")
    with (
        hapticdb.create(tmp_path / "x.db", grid, layout="voxel") as other,
        pytest.raises(UsageError, match="lexicographic"),
    ):
        sweep(other, ball(), poses)


# --- an object as the tool -----------------------------------------------------------------------


@pytest.fixture
def boxes(tmp_path: Path) -> Iterator[Environment]:
    """A small box a few voxels above a large box, both mirrored and scaled by two."""
    scene = trimesh.Scene()
    doubled = np.diag([-2.0, 2.0, 2.0, 1.0])
    for name, side, height in (("small", 0.05, 0.1), ("large", 0.2, -0.11)):
        placed = doubled.copy()
        placed[2, 3] = 2.0 * height
        scene.add_geometry(
            trimesh.creation.box((side,) * 3), node_name=name, geom_name=name, transform=placed
        )
    file = tmp_path / "boxes.glb"
    file.write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(voxel_size=0.005))
    hapticdb.import_files(tmp_path / "boxes.db", [file], options)
    with hapticdb.open(tmp_path / "boxes.db") as env:
        yield env


def test_an_object_becomes_the_tool_where_it_sits(boxes: Environment) -> None:
    part = next(obj for obj in boxes.objects() if obj.name == "small")
    shell = boxes.shell(part.id, points=500)
    assert (shell.points >= part.bounds[0] - 1e-9).all()
    assert (shell.points <= part.bounds[1] + 1e-9).all()
    itself = sweep(boxes, shell, [np.eye(4)])
    assert [one.object.name for one in itself.objects] == ["small"]
    away = [np.eye(4), pose_of((0, 0, 0.2))]
    out = sweep(boxes, shell, away, exclude=[part.id])
    assert out.comes_out
    assert out.clearance is not None
    bottom = float(part.bounds[0, 2]) - max(obj.bounds[1, 2] for obj in boxes.objects()[1:])
    assert out.clearance.at_least <= bottom <= out.clearance.at_most
    down = [np.eye(4), pose_of((0, 0, -0.2))]
    caught = sweep(boxes, shell, down, exclude=[part.id])
    assert [one.object.name for one in caught.objects] == ["large"]


def test_an_object_whose_file_has_changed_is_no_tool(boxes: Environment) -> None:
    obj = boxes.objects()[0]
    Path(obj.link).write_bytes(trimesh.creation.box((1, 1, 1)).export(file_type="glb"))
    with pytest.raises(GeometryChangedError, match="no longer holds"):
        boxes.shell(obj.id)
    Path(obj.link).unlink()
    with pytest.raises(GeometryChangedError, match="cannot be read"):
        boxes.shell(obj.id)


@pytest.mark.parametrize("far", [1e7, 1e307])
def test_a_path_of_absurd_length_is_refused_in_one_line_before_work(far: float) -> None:
    with pytest.raises(UsageError, match=r"^the path moves \S+ m, and turns a tool"):
        SweepPath.of(line((0, 0, 0), (far, far, 0)), ball(), SIZE)
