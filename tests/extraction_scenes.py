"""Assemblies of boxes with a part that comes out, or does not, by construction."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from hapticdb import Extraction, extract

Floats = NDArray[np.float64]

SIZE = 0.005
"""Edge of the voxels, metres; the pot and the drawer take twice as much."""


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    """A box between two corners, metres."""
    return trimesh.creation.box(bounds=np.array([low, high]))


def joined(*boxes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Boxes that make one part."""
    return trimesh.util.concatenate(boxes)


def imported(folder: Path, size: float = SIZE, **parts: trimesh.Trimesh) -> Path:
    """An environment of named parts with voxels of `size` metres."""
    scene = trimesh.Scene()
    for name, mesh in parts.items():
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    (folder / "parts.glb").write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(voxel_size=size))
    hapticdb.import_files(folder / "parts.db", [folder / "parts.glb"], options)
    return folder / "parts.db"


def found_in(url: Path, part: str, **options: Any) -> Extraction:  # noqa: ANN401
    with hapticdb.open(url, read_only=True) as env:
        return extract(env, part, **{"seconds": 500.0, **options})


def is_out(found: Extraction, url: Path) -> bool:
    """Whether the part's box has left the box of all else at the end of the path."""
    assert found.path is not None
    with hapticdb.open(url, read_only=True) as env:
        others = np.array([o.bounds for o in env.objects() if o.id != found.parts[0].id])
    placed = found.shell.points @ found.path.poses[-1][:3, :3].T + found.path.poses[-1][:3, 3]
    low, high = others[:, 0].min(axis=0), others[:, 1].max(axis=0)
    return bool((placed.min(axis=0) > high).any() or (placed.max(axis=0) < low).any())


def walls(
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    thick: float,
    open_side: str = "",
) -> trimesh.Trimesh:
    """A hollow box around a room between two corners; one side may be open: ``+z``, ``-y``."""
    room = np.array([low, high])
    outer = room + np.array([[-thick] * 3, [thick] * 3])
    if open_side:
        end, axis = "-+".index(open_side[0]), "xyz".index(open_side[1])
        outer[end, axis] = room[end, axis]
    plates = []
    for axis, name in enumerate("xyz"):
        for end, sign in ((0, "-"), (1, "+")):
            if sign + name == open_side:
                continue
            corners = outer.copy()
            corners[1 - end, axis] = room[end, axis]
            plates.append(trimesh.creation.box(bounds=corners))
    return joined(*plates)


def lid(folder: Path, gap: float) -> Path:
    """A flat lid above a pot that is open at its top."""
    pot = walls((0.0, 0.0, 0.0), (0.2, 0.2, 0.1), 0.02, "+z")
    top = 0.1 + gap
    return imported(
        folder, 2.0 * SIZE, pot=pot, lid=box((-0.02, -0.02, top), (0.22, 0.22, top + 0.02))
    )


def recessed(folder: Path, tilt: float) -> Path:
    """A bolt in a block, with a twentieth of a voxel of room around shaft and head, and below.

    The recess and the bore below it are open at the top, +z, where head and block end. Both are
    tilted by an angle about y.
    """
    head, shaft, room = 0.008, 0.003, 0.05 * SIZE
    block = []
    for low, high, hole in ((0.0, 0.02 - room, shaft + room), (0.02 - room, 0.03, head + room)):
        block += [
            box((-0.04, -0.04, low), (-hole, 0.04, high)),
            box((hole, -0.04, low), (0.04, 0.04, high)),
            box((-hole, -0.04, low), (hole, -hole, high)),
            box((-hole, hole, low), (hole, 0.04, high)),
        ]
    bolt = joined(
        box((-shaft, -shaft, 0.0), (shaft, shaft, 0.021)),
        box((-head, -head, 0.02), (head, head, 0.03)),
    )
    turn = trimesh.transformations.rotation_matrix(tilt, [0.0, 1.0, 0.0])
    return imported(
        folder, block=joined(*block).apply_transform(turn), bolt=bolt.apply_transform(turn)
    )


PITCH = 0.008
"""Metres a turn of the thread of `threaded`."""


def threaded(folder: Path) -> Path:
    """A nut on a right-handed bolt along z: ridges 3 mm high, with 2 mm of room to the nut."""

    def thread(low: float, high: float, room: float) -> trimesh.Trimesh:
        """Triangles of a thread: a ridge winds around z once a pitch."""
        heights = np.linspace(low, high, 1 + round(1000 * (high - low)))
        turn, height = np.meshgrid(np.linspace(0.0, 1.0, 13), heights)
        radius = 0.006 + 0.006 * np.abs((height / PITCH - turn) % 1.0 - 0.5) + room
        angle = 2.0 * np.pi * turn
        places = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
        n = np.arange(turn.size).reshape(turn.shape)
        a, b, c, d = n[:-1, :-1], n[:-1, 1:], n[1:, :-1], n[1:, 1:]
        faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
        return trimesh.Trimesh(places.reshape(-1, 3), faces, process=False)

    return imported(folder, 0.001, bolt=thread(0.0, 0.012, 0.0), nut=thread(0.003, 0.009, 0.002))


def drawer(folder: Path) -> Path:
    """A drawer in a shaft that is open in one direction, +y; 3 voxels of room on all sides."""
    shaft = walls((0.0, 0.0, 0.0), (0.2, 0.3, 0.1), 0.02, "+y")
    inside = box((0.03, 0.03, 0.03), (0.17, 0.27, 0.07))
    return imported(folder, 2.0 * SIZE, shaft=shaft, drawer=inside)


def corner(folder: Path) -> Path:
    """A block in a channel with a corner: up, and then along +x. No straight pull leads out.

    The channel is 0.08 m wide, the block 0.04 m. It stands at the lower end of the upright part.
    """
    upright = [
        box((-0.06, -0.06, -0.06), (-0.04, 0.06, 0.34)),  # the left side
        box((0.04, -0.06, -0.06), (0.06, 0.06, 0.22)),  # the right side, up to the opening
        box((-0.06, -0.06, -0.06), (0.06, 0.06, -0.04)),  # the bottom
        box((-0.06, -0.06, 0.32), (0.24, 0.06, 0.34)),  # the roof of both parts
        box((0.04, -0.06, 0.2), (0.24, 0.06, 0.22)),  # the floor of the part along x
    ]
    sides = [box((-0.06, y - 0.01, -0.06), (0.24, y + 0.01, 0.34)) for y in (-0.05, 0.05)]
    return imported(
        folder,
        1.6 * SIZE,
        channel=joined(*upright, *sides),
        block=box((-0.02, -0.02, -0.02), (0.02, 0.02, 0.02)),
    )


def enclosed(folder: Path) -> Path:
    """A block in a closed box, with an object beside the box that blocks nothing."""
    return imported(
        folder,
        cage=walls((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), 0.02),
        block=box((0.04, 0.04, 0.04), (0.06, 0.06, 0.06)),
        beside=box((0.3, 0.0, 0.0), (0.32, 0.02, 0.02)),
    )


def pocket(folder: Path) -> Path:
    """A block on the floor of a pocket, touching it; it is lifted, and then pulled along +x.

    A roof ends the lift, and the pocket's walls are higher than the block but for the roof's gap.
    """
    walls_of_pocket = [
        box((-0.06, -0.06, -0.02), (0.06, 0.06, 0.0)),  # the floor, which the block touches
        box((-0.06, -0.06, -0.02), (-0.04, 0.06, 0.16)),
        box((-0.06, -0.06, -0.02), (0.06, -0.04, 0.16)),
        box((-0.06, 0.04, -0.02), (0.06, 0.06, 0.16)),
        box((0.04, -0.06, -0.02), (0.06, 0.06, 0.06)),  # the lower side, towards +x
        box((-0.06, -0.06, 0.14), (0.12, 0.06, 0.16)),  # the roof
    ]
    return imported(
        folder, pocket=joined(*walls_of_pocket), block=box((-0.02, -0.02, 0.0), (0.02, 0.02, 0.04))
    )


def ledge(folder: Path) -> Path:
    """A plate between a floor and a ledge, touching both: it slides along +x, and then it lifts.

    The ledge covers 0.02 m of the plate; a stop ends the slide after 0.035 m, in contact with
    the floor. So no straight pull gets free.
    """
    base = [
        box((-0.02, -0.06, -0.02), (0.135, 0.06, 0.0)),  # the floor
        box((-0.02, -0.06, -0.02), (0.0, 0.06, 0.03)),  # behind
        box((-0.02, -0.06, 0.015), (0.02, 0.06, 0.03)),  # the ledge
        box((0.115, -0.06, -0.02), (0.135, 0.06, 0.03)),  # the stop
        box((-0.02, -0.06, -0.02), (0.135, -0.045, 0.03)),
        box((-0.02, 0.045, -0.02), (0.135, 0.06, 0.03)),
    ]
    return imported(folder, base=joined(*base), plate=box((0.0, -0.03, 0.0), (0.08, 0.03, 0.015)))


def bayonet(folder: Path) -> Path:
    """A bar across a slot, between floor and lid of a well: a quarter turn, and then it lifts."""
    well = [
        box((-0.08, -0.08, -0.02), (0.08, 0.08, 0.0)),
        box((-0.08, -0.08, -0.02), (-0.065, 0.08, 0.035)),
        box((0.065, -0.08, -0.02), (0.08, 0.08, 0.035)),
        box((-0.08, -0.08, -0.02), (0.08, -0.065, 0.035)),
        box((-0.08, 0.065, -0.02), (0.08, 0.08, 0.035)),
        box((-0.08, -0.08, 0.02), (-0.03, 0.08, 0.035)),  # the lid on both sides of the slot
        box((0.03, -0.08, 0.02), (0.08, 0.08, 0.035)),
    ]
    return imported(folder, well=joined(*well), bar=box((-0.05, -0.015, 0.0), (0.05, 0.015, 0.02)))


def room_with_a_door(folder: Path) -> Path:
    """A block in a pit of a room: up, along +x, and out by a door in the side +y.

    No end of a straight pull is in line with the door, neither along x nor along z.
    """
    thick = 0.02
    room = walls((0.0, 0.0, 0.0), (0.6, 0.16, 0.2), thick, "+y")
    side = [
        box((-thick, 0.16, -thick), (0.34, 0.18, 0.22)),
        box((0.48, 0.16, -thick), (0.62, 0.18, 0.22)),
        box((0.34, 0.16, -thick), (0.48, 0.18, 0.1)),  # the door's sill
    ]
    floor = box((0.16, 0.0, 0.0), (0.6, 0.16, 0.08))
    block = box((0.05, 0.05, 0.015), (0.11, 0.11, 0.075))
    return imported(folder, room=joined(room, *side, floor), block=block)


def solids(url: Path, part: str) -> Floats:
    """Corners (B, 2, 3) of the boxes that all but a part are made of, metres."""
    scene = trimesh.load(url.with_suffix(".glb"))
    return np.array(
        [
            piece.bounds
            for name, mesh in scene.geometry.items()
            if name != part
            for piece in mesh.split(only_watertight=True)
        ]
    )


def grounded(folder: Path) -> Path:
    """A block on the floor of a closed box, touching it: it slides, and never comes out."""
    return imported(
        folder,
        cage=walls((0.0, 0.0, 0.0), (0.08, 0.08, 0.06), 0.02),
        block=box((0.03, 0.03, 0.0), (0.05, 0.05, 0.02)),
    )


def shadow_planner(folder: Path, monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Put a planner that runs `code` when it is imported before the installed one."""
    shadow = folder / "shadow" / "ompl"
    shadow.mkdir(parents=True)
    (shadow / "__init__.py").write_text(code)
    monkeypatch.syspath_prepend(str(shadow.parent))  # a child has the path of its parent
