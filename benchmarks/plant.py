"""A plant of 114 machines for the browser view: about 4,000 parts, 1.9 million triangles."""

from pathlib import Path

import numpy as np
import trimesh

import hapticdb

MACHINES = 114
"""Machines, and different shapes."""
PARTS = 36
"""Parts of a machine; all machines together have 4,104."""


def shapes() -> list[trimesh.Trimesh]:
    """114 different shapes of 200 to 900 triangles."""
    rng = np.random.default_rng(7)
    made = []
    for number in range(MACHINES):
        size = rng.uniform(0.05, 0.16)
        kind = number % 6
        if kind == 0:
            shape = trimesh.creation.cylinder(size / 2, 3 * size, sections=60 + number)
        elif kind == 1:
            shape = trimesh.creation.torus(size, size / 4, major_sections=24, minor_sections=10)
        elif kind == 2:
            shape = trimesh.creation.annulus(size / 2, size, size, sections=40 + number // 2)
        elif kind == 3:
            shape = trimesh.creation.icosphere(2, size)
        elif kind == 4:
            shape = trimesh.creation.capsule(2 * size, size / 2, count=[16, 20])
        else:
            shape = trimesh.creation.box((3 * size, 2 * size, size))
            shape = shape.subdivide().subdivide().subdivide()
        shape.apply_scale(1 + number * 1e-3)
        made.append(shape)
    return made


def plant(*, shared: bool) -> trimesh.Scene:
    """Machines in rows; `shared`: parts of equal shape share their triangles."""
    rng = np.random.default_rng(8)
    known = shapes()
    scene = trimesh.Scene()
    for machine in range(MACHINES):
        x, y = 2.0 * (machine % 12), 2.4 * (machine // 12)
        for number in range(PARTS):
            which = int((machine * 5 + number * number) % MACHINES)
            place = trimesh.transformations.random_rotation_matrix(rng.random(3))
            layer, spot = divmod(number, 9)
            place[:3, 3] = x + 0.45 * (spot % 3), y + 0.45 * (spot // 3), 0.3 + 0.42 * layer
            shape = known[which]
            if not shared:
                shape = shape.copy()
                shape.vertices *= 1 + 1e-4 * rng.uniform(-1, 1)
            geometry = f"shape {which}" if shared else f"{machine}-{number}"
            name = f"row {machine // 12}/machine {machine}/part {number}"
            scene.add_geometry(shape, name, geom_name=geometry, transform=place)
    return scene


def imported(folder: Path, *, shared: bool) -> str:
    """URL of the imported plant; imported once in a folder."""
    stem = folder / ("instances" if shared else "distinct")
    if not stem.with_suffix(".db").exists():
        plant(shared=shared).export(stem.with_suffix(".glb"))
        options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=9), distances=False)
        hapticdb.import_files(stem.with_suffix(".db"), [stem.with_suffix(".glb")], options)
    return str(stem.with_suffix(".db"))
