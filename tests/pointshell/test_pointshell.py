"""A tool's mesh, however damaged, becomes evenly spread points with normals into the tool."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from hapticdb.errors import FileError, UsageError
from hapticdb.pointshell.orientation import components
from hapticdb.pointshell.shell import FORMAT, PointShell, fibonacci_sphere

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mesh = tuple[Floats, Ints]


def cube(edge: float = 1.0, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A cube from the corner `at`."""
    return hull_of(np.array(list(itertools.product((0.0, edge), repeat=3))) + at)


def hull_of(corners: Floats) -> Mesh:
    """The convex hull of its corners (n, 3), in random winding."""
    return corners, ConvexHull(corners).simplices.astype(np.int64)


def sphere(n: int = 600) -> Mesh:
    """A sphere of radius 1 about the origin."""
    return hull_of(fibonacci_sphere(n))


def torus(n: int = 48) -> Mesh:
    """A torus of radii 1 and 0.4 about the z axis."""
    made = trimesh.creation.torus(1.0, 0.4, n, n)
    return np.array(made.vertices), np.array(made.faces)


def together(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(corners) for corners, _ in meshes])
    return (
        np.concatenate([corners for corners, _ in meshes]),
        np.concatenate([faces + n for (_, faces), n in zip(meshes, starts, strict=False)]),
    )


def tumbled(mesh: Mesh, seed: int = 1) -> Mesh:
    """The same surface with every triangle wound at random and no corner shared."""
    corners, faces = mesh
    rng = np.random.default_rng(seed)
    flip = rng.random(len(faces)) < 0.5
    wound = np.where(flip[:, None], faces[:, ::-1], faces)
    return corners[wound].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


def write_stl(path: Path, mesh: Mesh) -> Path:
    trimesh.Trimesh(*mesh, process=False).export(path)
    return path


def cube_inward(points: Floats) -> Floats:
    """Inward normals of a cube of edge 1 at the origin, exact, at points on its faces."""
    offsets = np.concatenate((points, 1.0 - points), axis=1)
    inward: Floats = np.concatenate((np.eye(3), -np.eye(3)))[np.argmin(np.abs(offsets), axis=1)]
    return inward


@pytest.mark.parametrize("n", [1, 2, 7, 300, 1000])
def test_shell_point_count(n: int) -> None:
    shell = PointShell.from_mesh(*cube(), n)
    assert len(shell) == n
    assert shell.points.shape == shell.normals.shape == (n, 3)
    assert shell.points.flags.c_contiguous
    assert shell.normals.flags.c_contiguous


def test_shell_points_on_surface_exact_normals() -> None:
    shell = PointShell.from_mesh(*tumbled(cube()), 500)
    sides = np.minimum(np.abs(shell.points), np.abs(shell.points - 1.0)).min(axis=1)
    assert sides.max() <= 1e-15
    assert np.array_equal(shell.normals, cube_inward(shell.points))
    assert shell.is_closed
    assert np.allclose(shell.center, 0.5, atol=1e-15)


@pytest.mark.parametrize("n", [100, 3000])
def test_shell_neighbour_spacing(n: int) -> None:
    points = PointShell.from_mesh(*sphere(), n).points
    nearest = np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]
    area = ConvexHull(sphere()[0]).area
    assert nearest.min() > 0.6 * np.sqrt(2.0 * area / (np.sqrt(3.0) * n))


def test_shell_thin_wall_share_of_points() -> None:
    corners, faces = cube()
    fin = (corners * (2.0, 1.0, 0.004) + (1.5, 0.0, 0.0), faces)
    points = PointShell.from_mesh(*together((corners, faces), fin), 3000).points
    area = 2.0 * (2.0 + 0.012)
    assert np.mean(points[:, 0] > 1.25) == pytest.approx(area / (area + 6.0), rel=0.03)


@given(seed=st.integers(0, 2**32), shift=st.integers(-3, 3))
@settings(max_examples=15, deadline=None)
def test_shell_invariant_under_rigid_motion(seed: int, shift: int) -> None:
    corners, faces = torus(n=12)
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    offset = np.array([shift, -2.0 * shift, 0.5])
    here = PointShell.from_mesh(corners, faces, 60, seed=seed)
    there = PointShell.from_mesh(corners @ turn.T + offset, faces, 60, seed=seed)
    # The curve that orders the points follows the axes: a turned tool has another order.
    twin = np.asarray(cKDTree(there.points).query(here.points @ turn.T + offset)[1])
    assert len(np.unique(twin)) == 60
    assert np.allclose(there.points[twin], here.points @ turn.T + offset, atol=1e-12)
    assert np.allclose(there.normals[twin], here.normals @ turn.T, atol=1e-12)
    assert np.allclose(there.center, turn @ here.center + offset, atol=1e-12)


def test_shell_seed_reproducible() -> None:
    first, again, other = (PointShell.from_mesh(*torus(), 200, seed=s) for s in (5, 5, 6))
    assert np.array_equal(first.points, again.points)
    assert np.array_equal(first.normals, again.normals)
    assert not np.array_equal(first.points, other.points)


def mean_step(points: Floats) -> float:
    """Mean distance from each point to the one after it."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())


@pytest.mark.parametrize("stretch", [(1.0, 1.0, 1.0), (30.0, 1.0, 1.0), (1.0, 1.0, 0.01)])
def test_shell_order_spatially_coherent(
    stretch: tuple[float, float, float],
) -> None:
    corners, faces = torus()
    points = PointShell.from_mesh(corners * stretch, faces, 2000).points
    shuffled = np.random.default_rng(0).permutation(points)
    assert mean_step(points) < mean_step(shuffled) / 8.0
    nearest = np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]
    assert mean_step(points) < 3.0 * nearest.mean()


def test_shell_order_stable_under_rounding() -> None:
    # A cube's points lie at the ends of their bounding box, where no step of the curve may end.
    here, there = (PointShell.from_mesh(*cube(at=(x, 0.0, 0.0)), 500) for x in (0.0, 0.1))
    assert np.allclose(there.points, here.points + np.array([0.1, 0.0, 0.0]), atol=1e-12)


@pytest.mark.parametrize("state", ["outward", "inside out", "tumbled", "mirrored", "doubled"])
def test_shell_normals_inward_any_winding(state: str) -> None:
    corners, faces = torus()
    if state == "inside out":
        faces = faces[:, ::-1]
    elif state == "tumbled":
        corners, faces = tumbled((corners, faces))
    elif state == "mirrored":
        corners = corners * (-1.0, 1.0, 1.0)
    elif state == "doubled":
        corners, faces = together((corners, faces), tumbled((corners, faces)))
    shell = PointShell.from_mesh(corners, faces, 1000)
    flat = shell.points * (1.0, 1.0, 0.0)
    core = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    assert np.einsum("nk,nk->n", shell.normals, core - shell.points).min() > 0.0
    assert shell.is_closed
    assert np.allclose(shell.center, 0.0, atol=1e-12)


def test_shell_normals_in_cavity() -> None:
    hole = cube(0.5, (0.1, 0.25, 0.25))
    shell = PointShell.from_mesh(*tumbled(together(cube(), hole)), 800)
    in_hole = (np.abs(shell.points - 0.5) < 0.45).all(axis=1)
    assert in_hole.sum() > 100
    middle = np.array([0.35, 0.5, 0.5])
    outward = np.einsum("nk,nk->n", shell.normals, shell.points - middle)
    assert (outward[in_hole] > 0.0).all()
    assert np.array_equal(shell.normals[~in_hole], cube_inward(shell.points[~in_hole]))
    # Mass 1 at 0.5 less mass 1/8 at 0.35.
    assert np.allclose(shell.center, [(0.5 - 0.125 * 0.35) / 0.875, 0.5, 0.5], atol=1e-14)


@pytest.mark.parametrize("gap", [2.0, 1.0, 0.5])
def test_shell_bodies_apart_joined_overlapping(gap: float) -> None:
    pair = together(cube(), cube(at=(gap, 0.0, 0.0)))
    shell = PointShell.from_mesh(*tumbled(pair), 1000)
    assert shell.is_closed
    assert np.allclose(shell.center, [(1.0 + gap) / 2.0, 0.5, 0.5], atol=1e-14)
    for axis, level, normal in ((0, 0.0, 1.0), (0, gap + 1.0, -1.0), (2, 0.0, 1.0)):
        on_face = shell.points[:, axis] == level
        assert on_face.any()
        assert (shell.normals[on_face, axis] == normal).all()
    if gap == 0.5:
        assert (shell.normals[shell.points[:, 0] == 1.0, 0] == -1.0).all()


def test_shell_face_of_enclosed_body() -> None:
    """It is a wall between two bodies only if they lie on either side of it."""
    corners, faces = cube()
    pair = together((corners, faces), (corners * (1.0, 1.0, 0.5), faces))
    shell = PointShell.from_mesh(*tumbled(pair), 1000)
    assert not shell.is_closed
    for axis, level in itertools.product(range(3), (0.0, 1.0)):
        assert (shell.points[:, axis] == level).sum() > 50


def test_shell_open_hemisphere() -> None:
    corners, faces = sphere(n=2000)
    faces = faces[(corners[faces][:, :, 2] >= 0.0).all(axis=1)]
    shell = PointShell.from_mesh(*tumbled((corners, faces)), 300)
    assert not shell.is_closed
    assert np.einsum("nk,nk->n", shell.normals, -shell.points).min() > 0.0
    # Archimedes: the centroid of a hemisphere's surface is at half its height.
    assert np.allclose(shell.center, [0.0, 0.0, 0.5], atol=0.03)


def test_shell_flat_sheet_one_normal() -> None:
    corners, faces = cube(4.5)
    for _ in range(3):
        corners, faces = trimesh.remesh.subdivide(corners, faces)
    sheet = faces[(corners[faces][:, :, 2] == 0.0).all(axis=1)]
    shell = PointShell.from_mesh(*tumbled((corners, sheet)), 300)
    assert not shell.is_closed
    assert len(np.unique(shell.normals, axis=0)) == 1
    assert np.allclose(shell.center, [2.25, 2.25, 0.0])


def test_shell_corners_joined_within_tolerance() -> None:
    corners, faces = tumbled(sphere())
    noise = np.random.default_rng(3).uniform(-1e-7, 1e-7, corners.shape)
    assert PointShell.from_mesh(corners + noise, faces, 50).is_closed
    assert not PointShell.from_mesh(corners + 1e3 * noise, faces, 50).is_closed


def test_shell_degenerate_faces() -> None:
    corners, faces = cube()
    needles = np.array([[0, 0, 1], [2, 2, 2], [0, 7, 7]])
    clean, dirty = (
        PointShell.from_mesh(corners, f, 100) for f in (faces, np.concatenate((needles, faces)))
    )
    assert np.array_equal(clean.points, dirty.points)
    assert dirty.is_closed


def test_shell_far_from_origin() -> None:
    corners, faces = torus()
    far = np.array([4.5e6, 5.4e6, 500.0])
    shell = PointShell.from_mesh(corners + far, faces, 200)
    assert shell.is_closed
    assert np.allclose(shell.center, far, atol=1e-6)


@pytest.mark.parametrize("points", [0, -1, 10_000_001])
def test_shell_bad_point_count(points: int) -> None:
    with pytest.raises(UsageError, match="points"):
        PointShell.from_mesh(*cube(), points)


@pytest.mark.parametrize(
    ("mesh", "cause"),
    [
        ((np.zeros((3, 3)), [[0, 1, 2]]), "no area"),
        ((np.zeros((3, 3)), np.empty((0, 3), dtype=int)), "no triangles"),
        ((np.full((3, 3), np.nan), [[0, 1, 2]]), "not finite"),
        ((np.eye(3), [[0, 1, 3]]), "outside"),
        ((np.eye(3), [[0.0, 1.0, 2.0]]), "integers"),
        ((np.eye(2), [[0, 1, 1]]), "shape"),
    ],
)
def test_shell_mesh_without_surface(mesh: Mesh, cause: str) -> None:
    with pytest.raises(UsageError, match=cause):
        PointShell.from_mesh(*mesh, 10)


def test_shell_save_load_same_bits(tmp_path: Path) -> None:
    shell = PointShell.from_mesh(*torus(), 123, seed=9)
    path = tmp_path / "tool.shell.npz"
    shell.save(path)
    for loaded in (PointShell.load(path), PointShell.from_file(path)):
        assert loaded.points.tobytes() == shell.points.tobytes()
        assert loaded.normals.tobytes() == shell.normals.tobytes()
        assert loaded.center.tobytes() == shell.center.tobytes()
        assert (loaded.is_closed, loaded.link, loaded.seed) == (True, "", 9)
    with pytest.raises(UsageError, match="unit"):
        PointShell.from_file(path, unit="mm")


def test_shell_load_bad_file(tmp_path: Path) -> None:
    shell = PointShell.from_mesh(*cube(), 20)
    path = tmp_path / "tool.npz"
    shell.save(path)
    whole = path.read_bytes()
    contents = [b"", b"no zip", whole[: len(whole) // 2], whole[:-30]]
    contents.append(whole.replace(shell.points.tobytes(), b"\xff" * (20 * 24)))
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(FileError, match=r"tool\.npz") as caught:
            PointShell.load(path)
        assert "\n" not in str(caught.value)
    np.savez(path, points=shell.points)
    with pytest.raises(FileError, match="not a saved shell"):
        PointShell.load(path)
    np.savez(path, format=np.array([None], dtype=object))
    with pytest.raises(FileError, match="not a saved shell"):
        PointShell.load(path)
    with pytest.raises(FileError, match="no such file"):
        PointShell.load(tmp_path / "missing.npz")
    with pytest.raises(FileError, match="cannot write"):
        shell.save(tmp_path / "missing" / "tool.npz")


def test_shell_load_too_large_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "tool.npz"
    np.savez_compressed(path, format=np.array(FORMAT), points=np.zeros((200_000, 3)))
    monkeypatch.setattr("hapticdb.pointshell.shell.MAX_POINTS", 1000)
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("unpacked"))
    with pytest.raises(FileError, match=r"tool\.npz: 6\d+ points: a shell has 1 to 1000$"):
        PointShell.load(path)


def test_shell_constructor_checks() -> None:
    up = np.array([[0.0, 0.0, 1.0]])
    assert len(PointShell(np.zeros((1, 3)), up, np.zeros(3))) == 1
    for points, normals, center in (
        (np.zeros((2, 3)), up, np.zeros(3)),
        (np.zeros((1, 3)), 2.0 * up, np.zeros(3)),
        (np.zeros((1, 2)), up, np.zeros(3)),
        (np.full((1, 3), np.inf), up, np.zeros(3)),
        (np.zeros((1, 3)), up, np.zeros(2)),
        (np.empty((0, 3)), np.empty((0, 3)), np.zeros(3)),
    ):
        with pytest.raises(UsageError, match=r"shell|points|normals"):
            PointShell(points, normals, center)


def test_shell_from_file_frame_and_unit(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "tool.stl", tumbled(cube(at=(3.0, 4.0, 5.0))))
    shell = PointShell.from_file(path, 100)
    assert np.allclose(shell.center, [3.5, 4.5, 5.5])
    assert shell.is_closed
    assert Path(shell.link) == path.resolve()
    small = PointShell.from_file(path, 100, unit="mm")
    assert np.allclose(small.points, 1e-3 * shell.points, atol=1e-12)


def test_shell_from_file_without_surface(tmp_path: Path) -> None:
    corners, faces = cube()
    flat = write_stl(tmp_path / "line.stl", (corners * (1.0, 0.0, 0.0), faces))
    with pytest.raises(FileError, match=r"line\.stl.*no area"):
        PointShell.from_file(flat)
    cloud = tmp_path / "cloud.ply"
    cloud.write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n1 1 1\n"
    )
    with pytest.raises(FileError, match=r"cloud\.ply.*surface"):
        PointShell.from_file(cloud)
    with pytest.raises(FileError, match=r"missing\.stl"):
        PointShell.from_file(tmp_path / "missing.stl")


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_components_equal_scipy(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 30))
    node = st.integers(0, n - 1)
    pairs = np.array(data.draw(st.lists(st.tuples(node, node))), np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(n, n))
    found = components(pairs, n)
    assert found.dtype == np.int64
    assert found.tolist() == connected_components(graph, directed=False)[1].tolist()
