"""Animation of removal paths: a standalone HTML page with viser's player."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from viser import SceneNodeHandle, ViserServer

from hapticdb.environment import Environment
from hapticdb.errors import FileError
from hapticdb.exact.sweep_report import names_of
from hapticdb.extraction.extraction_results import Extraction
from hapticdb.grid import corners_of
from hapticdb.ingest.geometry import parts_of
from hapticdb.page import colours
from hapticdb.page.drawing import put_at
from hapticdb.page.page_process import new_server, stop
from hapticdb.page.scene.facets import Facets, block_facets, coarsened, sharpened
from hapticdb.page.scene.surroundings import add_surroundings
from hapticdb.pointshell.orientation import Surface
from hapticdb.poses import row_of_pose
from hapticdb.store.attributes import AXES, up_axis
from hapticdb.store.base import Object

Floats = NDArray[np.float64]

PLACES = 72
"""Poses per path. More: smoother motion, larger file."""
PICTURES = 24.0
"""Poses per second of playback."""
PAUSE = 0.8
"""Pause before and after each path, seconds."""
AROUND = 0.6
"""Margin of the surroundings, as a share of the longest edge of the paths' AABB."""

_Move = tuple[SceneNodeHandle, Floats, SceneNodeHandle]
"""A step of the animation: node of its parts, poses (n, 4, 4), and label."""


def animate(
    path: str | os.PathLike[str],
    env: Environment,
    steps: Sequence[Extraction],
    *,
    exclude: Iterable[int] = (),
    up: str | None = None,
) -> None:
    """Write an HTML page that plays removal paths one after another, in a loop.

    The page needs no server. An existing file is replaced. Raises `FileError` if the file cannot be
    written.

    steps : each with a path, in order of removal; exclude : ids of hidden objects, unless a step
    removes them; up : vertical axis 'x', 'y' or 'z', by default that of most of the objects' files.
    """
    server = new_server()
    try:
        page = _recorded(server, env, steps, {*exclude}, up)
    finally:
        stop(server)
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def _recorded(
    server: ViserServer, env: Environment, steps: Sequence[Extraction], exclude: set[int],
    up: str | None,
) -> str:  # fmt: skip
    """HTML page of the scene with all steps."""
    axis = up_axis(env.objects()) if up is None else AXES.index(up)
    paths = [_shown_poses(found) for found in steps]
    box = _box_of(steps, paths)
    add_surroundings(server, box, axis)
    server.scene.world_axes.visible = False
    exclude |= {obj.id for found in steps for obj in found.parts}
    facets, middle = _sent(_standing(env, box, exclude))
    if len(facets.faces):
        server.scene.add_mesh_simple(
            "/standing", facets.vertices, facets.faces, color=(186, 193, 201), opacity=0.45,
            side="double", cast_shadow=False, receive_shadow=False, position=middle,
        )  # fmt: skip
    top = box.mean(axis=0)
    top[axis] = box[1, axis]
    moves = [
        _move(server, n, found, poses, top)
        for n, (found, poses) in enumerate(zip(steps, paths, strict=True))
    ]
    return _played(server, moves)


def _move(server: ViserServer, number: int, found: Extraction, poses: Floats, top: Floats) -> _Move:
    """Add the parts of a step in a colour of their own, with a hidden label."""
    surface = found.shell.surface
    assert isinstance(surface, Surface)  # noqa: S101 - parts have a surface
    facets, middle = _sent([_of_triangles(surface.triangles)])
    node = server.scene.add_mesh_simple(
        f"/part_{number}", facets.vertices, facets.faces, color=colours.of_object(number),
        side="double", cast_shadow=False, receive_shadow=False,
    )  # fmt: skip
    words = f"{number + 1}. {names_of(found.parts)}: {found.verdict}"
    label = server.scene.add_label(f"/words_{number}", words, position=tuple(top), visible=False)
    # vertices are sent relative to their middle: the node's poses carry it
    from_middle = np.eye(4)
    from_middle[:3, 3] = middle
    return node, poses @ from_middle, label


def _played(server: ViserServer, moves: Sequence[_Move]) -> str:
    recording = server.get_scene_serializer()
    for node, poses, _ in moves:  # initial state of each loop; viser records changes only
        put_at(node, row_of_pose(poses[-1]))
        put_at(node, row_of_pose(poses[0]))
        node.visible = False
        node.visible = True
    for node, poses, words in moves:
        words.visible = True
        recording.insert_sleep(PAUSE)
        for pose in poses:
            put_at(node, row_of_pose(pose))
            recording.insert_sleep(1.0 / PICTURES)
        recording.insert_sleep(PAUSE)
        node.visible = words.visible = False
    recording.insert_sleep(1.0 / PICTURES)
    return str(recording.as_html())


def _shown_poses(found: Extraction) -> Floats:
    """Displacements (n, 4, 4), evenly spaced in the path parameter, both ends included."""
    assert found.path is not None  # noqa: S101 - each step has a path
    path = found.path.swept.path
    return path.at(np.linspace(0.0, path.length, PLACES))


def _box_of(steps: Sequence[Extraction], paths: Sequence[Floats]) -> Floats:
    """AABB (2, 3) of all parts along their paths."""
    corners = []
    for found, poses in zip(steps, paths, strict=True):
        low, high = found.shell.points.min(axis=0), found.shell.points.max(axis=0)
        own = corners_of(np.stack([low, high])) @ poses[:, :3, :3].swapaxes(1, 2)
        corners.append((own + poses[:, None, :3, 3]).reshape(-1, 3))
    every = np.concatenate(corners)
    return np.stack([every.min(axis=0), every.max(axis=0)])


def _standing(env: Environment, box: Floats, exclude: set[int]) -> list[Facets]:
    """Facets of the objects near an AABB (2, 3), the smallest objects first."""
    reach = AROUND * float((box[1] - box[0]).max())
    near = [
        obj
        for obj in env.objects()
        if obj.id not in exclude
        and (obj.bounds[1] > box[0] - reach).all()
        and (obj.bounds[0] < box[1] + reach).all()
    ]
    shapes = [
        _of_voxels(env, obj) if part.is_cloud else _of_triangles(part.triangles(obj.transform))
        for obj, part in parts_of(env.store, near)
    ]
    kept, total = [], 0
    for facets in sorted(shapes, key=lambda one: len(one.faces)):
        total += len(facets.faces)
        if total <= 400_000:  # the largest objects are dropped
            kept.append(facets)
    return kept


def _of_triangles(triangles: Floats) -> Facets:
    """Facets of triangles (F, 3, 3), split at sharp edges."""
    faces = np.arange(3 * len(triangles), dtype=np.int64).reshape(-1, 3)
    return sharpened([Facets(triangles.reshape(-1, 3), faces)])[0]


def _of_voxels(env: Environment, obj: Object) -> Facets:
    blocks = block_facets(*coarsened(env.voxels(obj.id), 20_000))
    corners = np.asarray(env.grid.origin) + env.grid.voxel_size * blocks.vertices
    return Facets(corners, blocks.faces)


def _sent(several: Sequence[Facets]) -> tuple[Facets, Floats]:
    """One mesh, float32 about its centre (3,) for parts far from the origin, and that centre."""
    if not several:
        return Facets(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint32)), np.zeros(3)
    first = np.cumsum([0, *(len(facets.vertices) for facets in several)])
    faces = [one.faces + start for one, start in zip(several, first.tolist(), strict=False)]
    vertices = np.concatenate([one.vertices for one in several]).astype(np.float64)
    middle = vertices.mean(axis=0)
    sent = Facets((vertices - middle).astype(np.float32), np.concatenate(faces).astype(np.uint32))
    return sent, middle
