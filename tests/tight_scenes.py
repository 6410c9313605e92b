"""Tight random scenes for sweeps: tools that nearly touch, or touch only between samples or points.

Each kind of trial is made so that one error of a proof shows. Objects stand far apart on a lattice;
an oracle gives the exact distances, so a trial need not turn out as it was meant.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hapticdb import PointShell
from hapticdb.sweeps.result import Swept
from naive_motion import middle_of, poses_at

Floats = NDArray[np.float64]
Oracle = Callable[[Floats], tuple[Floats, NDArray[np.bool_]]]
"""Least distance (B,) of the tool's surface from all others at poses (B, 4, 4), and whether the
tool holds an object (B,)."""

SIZE = 0.01
"""Edge of a voxel, metres."""
ORIGIN = (-0.64, -0.64, -0.64)
PITCH = 30
"""Voxels between objects: more than a long tool reaches."""
FILE = 1e-7
"""Metres: vertices in single precision, as the file has them, are as near to the exact ones."""
DIAGONAL = float(np.sqrt(3.0)) * SIZE


class Feature(NamedTuple):
    """A sharp place of an object, metres, world frame: place, along, out (3,), both of unit length.

    along: direction of the edge; out: direction away from the object.
    """

    place: Floats
    along: Floats
    out: Floats


class TightScene(NamedTuple):
    """Closed objects, world frame; needles and nuts: indices of those that are thin, or small."""

    objects: list[trimesh.Trimesh]
    needles: list[int]
    nuts: list[int]


class Trial(NamedTuple):
    """A tool, its shell, and the poses (M, 4, 4) of its path."""

    kind: str
    tool: trimesh.Trimesh
    shell: PointShell
    poses: Floats


def unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def direction(rng: np.random.Generator) -> Floats:
    return unit(rng.normal(size=3))


def tilted(rng: np.random.Generator, way: Floats, most: float) -> Floats:
    """A direction at most `most` radians from another."""
    return Rotation.from_rotvec(rng.uniform(0.0, most) * direction(rng)).apply(way)


def turn_to(rng: np.random.Generator, start: Floats, end: Floats) -> Floats:
    """A random rotation (3, 3) of the direction `start` to `end`."""
    axis = np.cross(start, end)
    if np.linalg.norm(axis) < 1e-9:
        axis = np.cross(start, np.roll(start, 1) + np.array([0.3, 0.1, 0.2]))
    angle = np.arctan2(np.linalg.norm(np.cross(start, end)), start @ end)
    spin = Rotation.from_rotvec(rng.uniform(0.0, 2.0 * np.pi) * end)
    return np.asarray((spin * Rotation.from_rotvec(angle * unit(axis))).as_matrix())


def pose_with(rotation: Floats, local: Floats, world: Floats) -> Floats:
    """The pose (4, 4) with a rotation that brings a place of the tool to a place of the world."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, world - rotation @ local
    return pose


def shifted(pose: Floats, way: Floats) -> Floats:
    moved = pose.copy()
    moved[:3, 3] += way
    return moved


def turned_about(pose: Floats, place: Floats, turn: Floats) -> Floats:
    """A pose, turned about a place of the world by a rotation vector."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = rotation @ pose[:3, :3], rotation @ (pose[:3, 3] - place) + place
    return moved


# --- objects -------------------------------------------------------------------------------------


def box(halves: Any) -> trimesh.Trimesh:  # noqa: ANN401 - a triple, voxels
    return trimesh.creation.box(2.0 * SIZE * np.asarray(halves, dtype=float))


def edges_of(mesh: trimesh.Trimesh) -> list[Feature]:
    """A feature at the middle of each sharp edge; `along` has half of the edge's length."""
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > 0.1)
    ends = mesh.vertices[mesh.face_adjacency_edges[sharp]]
    outs = mesh.face_normals[mesh.face_adjacency[sharp]].sum(axis=1)
    return [
        Feature(np.asarray(pair.mean(axis=0)), 0.5 * np.asarray(pair[1] - pair[0]), unit(out))
        for pair, out in zip(ends, outs, strict=True)
    ]


def edge(rng: np.random.Generator, mesh: trimesh.Trimesh) -> Feature:
    """A random place on a random sharp edge."""
    found = edges_of(mesh)
    one = found[rng.integers(len(found))]
    return Feature(one.place + rng.uniform(-0.9, 0.9) * one.along, unit(one.along), one.out)


def frame_of(made: trimesh.Trimesh) -> tuple[Floats, Floats]:
    """Pose (4, 4) of a box's middle and its half edges (3,), metres; its vertices are in order."""
    corner = made.vertices[0]
    sides = 0.5 * (made.vertices[[4, 2, 1]] - corner)
    pose, halves = np.eye(4), np.linalg.norm(sides, axis=1)
    pose[:3, :3], pose[:3, 3] = (sides / halves[:, None]).T, made.vertices.mean(axis=0)
    return pose, halves


def tip(rng: np.random.Generator, needle: trimesh.Trimesh) -> Feature:
    """The middle of one end of a needle."""
    frame, halves = frame_of(needle)
    axis = int(halves.argmax())
    out = frame[:3, axis] * rng.choice([-1.0, 1.0])
    return Feature(frame[:3, 3] + halves[axis] * out, frame[:3, (axis + 1) % 3], out)


def set_up(rng: np.random.Generator, mesh: trimesh.Trimesh, cell: Floats) -> trimesh.Trimesh:
    """Place an object near a cell of the lattice: turned, or along the axes.

    One that lies along the axes fills its voxels up to a fiftieth at its lower corner, so bounds by
    voxels are nearly exact there.
    """
    made, pose = mesh.copy(), np.eye(4)
    if rng.random() < 0.5:
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = SIZE * (PITCH * cell + rng.uniform(-3.0, 3.0, 3))
    else:
        pose[:3, :3] = np.eye(3)[rng.permutation(3)]
        pose[:3] *= np.linalg.det(pose[:3, :3])  # a mirrored one is the same box, for a box alone
        low = (mesh.bounds @ pose[:3, :3].T).min(axis=0)
        pose[:3, 3] = SIZE * (PITCH * cell + rng.integers(-3, 4, 3) + 0.02) - low
    made.apply_transform(pose)
    return made


def tight_scene(rng: np.random.Generator, others: Sequence[trimesh.Trimesh]) -> TightScene:
    """Two needles, a nut, a thin plate and a cube, and others, far from one another."""
    needles = [box((*rng.uniform(0.05, 0.48, 2), rng.uniform(5.0, 9.0))) for _ in range(2)]
    nut = box(rng.uniform(0.5, 0.98, 3))
    plate = box((rng.uniform(0.1, 0.4), *rng.uniform(3.0, 6.0, 2)))
    cube = box(rng.integers(2, 4, 3) - 0.02)
    meshes = [*needles, nut, plate, cube, *others]
    cells = np.array(np.unravel_index(rng.permutation(27)[: len(meshes)], (3, 3, 3))).T - 1.0
    objects = [set_up(rng, one, cell) for one, cell in zip(meshes, cells, strict=True)]
    return TightScene(objects, [0, 1], [2])


# --- trials --------------------------------------------------------------------------------------


def worst_place(tool: trimesh.Trimesh, shell: PointShell) -> tuple[Floats, Floats]:
    """The place of a tool's surface that is farthest from all points, and its outward normal."""
    u, v = np.meshgrid(*[np.linspace(0.0, 1.0, 25)] * 2)
    u, v = u[u + v <= 1.0], v[u + v <= 1.0]
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    places = np.einsum("wc,fck->fwk", weights, tool.triangles)
    apart = np.asarray(cKDTree(shell.points).query(places)[0])
    face, place = np.unravel_index(int(apart.argmax()), apart.shape)
    return np.asarray(places[face, place]), np.asarray(tool.face_normals[face])


def farthest_vertex(rng: np.random.Generator, tool: trimesh.Trimesh, middle: Floats) -> Floats:
    """One of the tool's vertices that are farthest from its middle."""
    ways = np.linalg.norm(tool.vertices - middle, axis=1)
    return np.asarray(rng.choice(tool.vertices[ways > 0.99 * ways.max()]))


def shell_of(tool: trimesh.Trimesh, n: int, **options: Any) -> PointShell:  # noqa: ANN401
    return PointShell.from_mesh(tool.vertices, tool.faces, seed=n, **options)


def hole(rng: np.random.Generator, scene: TightScene, tool: trimesh.Trimesh) -> Trial:
    """A needle's tip at the place of a coarse shell that is farthest from its points."""
    shell = shell_of(tool, int(rng.integers(99)), points=int(rng.integers(30, 70)))
    local, normal = worst_place(tool, shell)
    end = tip(rng, scene.objects[rng.choice(scene.needles)])
    rotation = turn_to(rng, normal, tilted(rng, -end.out, 0.5))
    deep = SIZE * rng.uniform(-0.6, 0.8)
    pose = pose_with(rotation, local, end.place - deep * end.out)
    how = rng.integers(3)
    if how == 0:
        poses = [pose, pose]
    elif how == 1:  # up to the tip, and on beside it
        poses = [shifted(pose, 2.0 * SIZE * end.out), pose, shifted(pose, 0.2 * SIZE * end.along)]
    else:
        turns = rng.uniform(0.0, 0.1) * direction(rng) * np.array([[-1.0], [1.0]])
        poses = [turned_about(pose, end.place, turn) for turn in turns]
    return Trial("hole", tool, shell, np.array(poses))


WAYS = ((0.3, 0.45), (0.8, 0.95), (0.8, 0.95), (2.4, 2.9), (0.3, 3.0))
"""Voxels that a corner goes past an edge, from and to. With steps of half a voxel the edge is in
the middle of one step; with the others, were steps twice as long as they may be."""


def past_edge(rng: np.random.Generator, scene: TightScene, tool: trimesh.Trimesh) -> Trial:
    """A corner of a finely covered tool passes close to an edge: straight, or in a turn."""
    shell = shell_of(tool, int(rng.integers(99)), points=2500)
    middle = middle_of(shell.points)
    near = edge(rng, scene.objects[rng.integers(len(scene.objects))])
    vertex = farthest_vertex(rng, tool, middle)
    rotation = turn_to(rng, unit(vertex - middle), tilted(rng, -near.out, 0.3))
    gap = SIZE * (rng.uniform(-0.05, 0.3) if rng.random() < 0.7 else rng.uniform(0.3, 2.5))
    pose = pose_with(rotation, vertex, near.place + gap * near.out)
    center = pose[:3, :3] @ middle + pose[:3, 3]
    way = unit(np.cross(near.along, near.out))
    half = 0.5 * SIZE * rng.uniform(*WAYS[rng.integers(len(WAYS))])
    if rng.random() < 0.4:
        poses = [shifted(pose, sign * half * way) for sign in (-1.0, 1.0)]
    else:
        angle = half / float(np.linalg.norm(vertex - middle))
        if rng.random() < 0.4:
            angle = rng.uniform(0.1, 0.5 * np.pi)
        poses = [turned_about(pose, center, sign * angle * near.along) for sign in (-1.0, 1.0)]
    if rng.random() < 0.3:  # from afar, and back
        far = SIZE * rng.uniform(3.0, 10.0) * near.out
        poses = [shifted(poses[0], far), *poses, shifted(poses[1], far)]
    return Trial("past edge", tool, shell, np.array(poses))


def through(rng: np.random.Generator, scene: TightScene, tool: trimesh.Trimesh) -> Trial:
    """From close beside an object, straight through another one, and away."""
    shell = shell_of(tool, int(rng.integers(99)), spacing=0.5 * SIZE)
    first, other = (scene.objects[n] for n in rng.permutation(len(scene.objects))[:2])
    there = np.asarray(other.bounds.mean(axis=0)) + SIZE * rng.uniform(-1.0, 1.0, 3)
    here = np.asarray(first.bounds.mean(axis=0))
    out, rotation = unit(there - here), Rotation.random(rng=rng).as_matrix()
    ends = [float((mesh @ way).max()) for mesh, way in (
        (first.vertices, out), (tool.vertices @ rotation.T, -out)
    )]  # fmt: skip
    start = here + (ends[0] - here @ out + ends[1] + SIZE * rng.uniform(0.3, 2.5)) * out
    beyond = there + SIZE * rng.uniform(8.0, 12.0) * out
    pose = pose_with(rotation, np.zeros(3), start)
    turn = rng.uniform(0.0, 1.0) * direction(rng)
    poses = [pose, turned_about(shifted(pose, beyond - start), beyond, turn)]
    return Trial("through", tool, shell, np.array(poses))


def around_nut(rng: np.random.Generator, scene: TightScene, _: trimesh.Trimesh) -> Trial:
    """A closed box around a small object."""
    tool = box(rng.uniform(3.5, 6.0, 3))
    shell = shell_of(tool, int(rng.integers(99)), spacing=0.6 * SIZE)
    nut = scene.objects[rng.choice(scene.nuts)]
    place = np.asarray(nut.bounds.mean(axis=0)) + SIZE * rng.uniform(-1.0, 1.0, 3)
    pose = pose_with(Rotation.random(rng=rng).as_matrix(), np.zeros(3), place)
    end = turned_about(shifted(pose, SIZE * rng.uniform(-0.5, 0.5, 3)), place, 0.1 * direction(rng))
    return Trial("around nut", tool, shell, np.array([pose, end]))


def rod(rng: np.random.Generator) -> trimesh.Trimesh:
    return box((*rng.uniform(0.08, 0.2, 2), rng.uniform(2.0, 8.0)))


def blunt(rng: np.random.Generator) -> trimesh.Trimesh:
    return box(rng.permutation([rng.uniform(0.5, 4.0), *rng.uniform(4.0, 6.0, 2)]))


KINDS = (hole, past_edge, through, past_edge, around_nut, past_edge, past_edge)
"""How trials are made, in turn. Edges show wrong motion bounds in few of the trials."""


def trial(rng: np.random.Generator, scene: TightScene, n: int) -> Trial:
    """The n-th trial in a scene: a rod where an edge is passed, and else a plate or a block."""
    kind = KINDS[n % len(KINDS)]
    return kind(rng, scene, rod(rng) if kind is past_edge else blunt(rng))


# --- the judge -----------------------------------------------------------------------------------


def least_along(poses: Floats, shell: PointShell, oracle: Oracle) -> tuple[float, bool]:
    """Least exact distance on a path, sampled ever closer where it is least; whether it holds any.

    The motion is that of plain formulas, and no pose of the path that is judged takes part.
    """
    middle, last = middle_of(shell.points), float(len(poses) - 1)
    times = np.linspace(0.0, last, 48 * int(last) + 1)
    least, holds, step = np.inf, False, 1.0 / 48
    for _ in range(3):
        apart, held = oracle(poses_at(poses, middle, times))
        least, holds = min(least, float(apart.min())), holds or bool(held.any())
        around = times[int(apart.argmin())]
        times = np.clip(around + np.linspace(-step, step, 17), 0.0, last)
        step /= 8.0
    return least, holds


def check(
    found: Swept, poses: Floats, shell: PointShell, oracle: Oracle, tolerance: float | None
) -> str:
    """Compare a sweep with the exact distances; returns the verdict."""
    least, holds = least_along(poses, shell, oracle)
    if found.verdict == "comes out":
        assert not holds
        assert least > 0.0
        assert found.at_least <= least + FILE
    elif found.enclosed:  # half a voxel inside at its centre
        assert holds or least <= 0.5 * (DIAGONAL - SIZE) + FILE
    elif found.verdict == "hits":
        if tolerance is not None:
            assert found.decision is not None
            assert found.decision.near is not None
            there = oracle(found.decision.near.pose[None])[0].min()
            assert there <= found.decision.within + FILE <= min(tolerance, DIAGONAL) + 2 * FILE
        else:
            assert found.first_hit is not None
            assert oracle(found.first_hit.pose[None])[0].min() <= DIAGONAL + FILE
    elif found.decision is not None:
        assert least <= found.decision.within + FILE
    if found.clearance is not None and found.proof.cover is not None:
        assert found.clearance.at_least <= least + FILE
        if found.clearance.moment is not None:
            there = oracle(found.clearance.moment.pose[None])[0].min()
            assert there <= found.clearance.at_most + FILE
    return found.verdict
