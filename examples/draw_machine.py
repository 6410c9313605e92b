"""Draws docs/machine.png: a robot carries from a conveyor into a rack, in a hall of 4,000 parts.

The path is swept first; the picture, and the gaps along the path as .svg, are written if it is
clear.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import ImageDraw

import hapticdb
from hapticdb.grid import GridOptions
from hapticdb.machines import solids
from hapticdb.machines.joint_path import checked_values
from hapticdb.pictures.canvas import Canvas
from hapticdb.pictures.clash_page import PAPER, TINTS

Floats = NDArray[np.float64]

PARTS = 4000
SIZE = 760, 440
"""Width and height of the picture, pixels."""
VIEW = np.array([[[-1.9, -1.9, 0.0], [1.9, 1.4, 2.5]]])
"""Box in the picture, metres; parts in front of it are left out."""
GROUPS = {
    "floor": (0.88, 0.89, 0.91), "rack/upright": TINTS[1], "rack/shelf": TINTS[1],
    "rack/crate": (0.72, 0.62, 0.47), "conveyor": (0.55, 0.6, 0.66),
}  # fmt: skip
"""Colours of parts by the beginnings of their names; others are left out."""
ROBOT = """<robot name="loader">
  <link name="foot"><collision><origin xyz="0 0 0.25"/>
    <geometry><cylinder radius="0.16" length="0.5"/></geometry></collision></link>
  <link name="shoulder"><collision><origin xyz="0 0 0.1"/>
    <geometry><box size="0.24 0.3 0.28"/></geometry></collision></link>
  <link name="upper_arm"><collision><origin xyz="0.45 0 0"/>
    <geometry><box size="1.02 0.12 0.14"/></geometry></collision></link>
  <link name="forearm"><collision><origin xyz="0.42 0 0" rpy="0 1.5707963 0"/>
    <geometry><cylinder radius="0.05" length="0.84"/></geometry></collision></link>
  <link name="wrist"><collision><geometry><sphere radius="0.06"/></geometry></collision></link>
  <link name="hand"><collision><origin xyz="0.1 0 0"/>
    <geometry><box size="0.08 0.16 0.06"/></geometry></collision></link>
  <link name="left"><collision><origin xyz="0.19 0 0"/>
    <geometry><box size="0.1 0.02 0.04"/></geometry></collision></link>
  <link name="right"><collision><origin xyz="0.19 0 0"/>
    <geometry><box size="0.1 0.02 0.04"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="foot"/><child link="shoulder"/>
    <origin xyz="0 0 0.54"/><axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>
  <joint name="lift" type="revolute"><parent link="shoulder"/><child link="upper_arm"/>
    <origin xyz="0 0 0.2"/><axis xyz="0 -1 0"/><limit lower="-0.5" upper="2.3"/></joint>
  <joint name="bend" type="revolute"><parent link="upper_arm"/><child link="forearm"/>
    <origin xyz="0.9 0 0"/><axis xyz="0 -1 0"/><limit lower="-2.6" upper="0.5"/></joint>
  <joint name="roll" type="continuous"><parent link="forearm"/><child link="wrist"/>
    <origin xyz="0.9 0 0"/><axis xyz="1 0 0"/></joint>
  <joint name="nod" type="revolute"><parent link="wrist"/><child link="hand"/>
    <axis xyz="0 -1 0"/><limit lower="-2" upper="2"/></joint>
  <joint name="grip" type="prismatic"><parent link="hand"/><child link="left"/>
    <origin xyz="0 0.02 0"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04"/></joint>
  <joint name="other" type="prismatic"><parent link="hand"/><child link="right"/>
    <origin xyz="0 -0.02 0"/><axis xyz="0 -1 0"/><mimic joint="grip"/></joint>
</robot>
"""
PATH = np.array(
    [[90, 76.7, -105, 0, -61.7, 4], [90, 90, -105, 0, -60, 3], [0, 95, -110, 90, 15, 3],
     [-90, 90, -115, 180, -25, 3], [-90, 63.8, -90.7, 180, -26.9, 4], [-90, 90, -115, 180, -25, 4]]
) * [*[np.pi / 180.0] * 5, 0.01]  # fmt: skip
"""Joint path: from the conveyor into the rack, and out of it."""

Box = tuple[str, tuple[float, float, float], tuple[float, float, float]]


def hall() -> Iterator[Box]:
    """Names, edges and middles of the parts, metres."""
    yield "floor", (12.0, 8.0, 0.1), (0.0, 0.0, -0.05)
    for side, front in (("rack", -1.1), ("rack behind", 1.9)):
        for x in np.arange(-5.5, 5.0):
            for y in (front - 0.02, front - 0.78) if front < 0 else (front + 0.02, front + 0.78):
                yield f"{side}/upright", (0.04, 0.04, 2.4), (x, y, 1.2)
        for x in np.arange(-5.0, 4.1):
            for z in (0.4, 0.9, 1.4, 1.9):
                yield f"{side}/shelf", (0.96, 0.8, 0.03), (x, front + 0.4 * np.sign(front), z)
                for n in range(40):
                    across, deep, high = n % 10, n // 10 % 2, n // 20
                    y = front + np.sign(front) * (0.55 + 0.17 * deep)
                    at = (x - 0.42 + 0.093 * across, y, z + 0.11 + 0.18 * high)
                    yield f"{side}/crate", (0.08, 0.15, 0.17), at
    for x in np.linspace(-5.0, 5.0, 150):
        yield "conveyor/roller", (0.05, 0.5, 0.05), (x, 1.0, 0.7)
    for y in (0.73, 1.27):
        yield "conveyor/rail", (10.2, 0.03, 0.08), (0.0, y, 0.7)
        for x in np.linspace(-5.0, 5.0, 6):
            yield "conveyor/leg", (0.04, 0.03, 0.66), (x, y, 0.33)
    for y in (-0.6, 0.6):
        yield "ladder/rail", (10.2, 0.03, 0.06), (0.0, y, 2.6)


def parts() -> list[Box]:
    """All parts, `PARTS` with the rungs of a cable ladder."""
    found = list(hall())
    rungs = np.linspace(-5.0, 5.0, PARTS - len(found)).tolist()
    found += [("ladder/rung", (0.01, 1.2, 0.02), (x, 0.0, 2.6)) for x in rungs]
    return [(f"{name} {n}", edges, middle) for n, (name, edges, middle) in enumerate(found)]


def swept(folder: Path) -> tuple[hapticdb.Machine, hapticdb.Swept]:
    """Import the hall, and prove the path of the machine."""
    scene = trimesh.Scene()
    for name, edges, middle in parts():
        mesh = trimesh.creation.box(edges)
        mesh.apply_translation(middle)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    (folder / "hall.glb").write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=GridOptions(bits=8), distances=False)
    hapticdb.import_files(folder / "hall.db", [folder / "hall.glb"], options)
    (folder / "loader.urdf").write_text(ROBOT)
    machine = hapticdb.read_machine(folder / "loader.urdf")
    with hapticdb.open(folder / "hall.db", read_only=True) as env:
        for _ in range(2):  # the first one loads kernels
            began = time.process_time()
            found = hapticdb.sweep_machine(env, machine, PATH, within=0.2)
        place = found.gap.place
        print(f"{found!r}: {len(env.objects()):,} parts, {time.process_time() - began:.2f} s of")
        print(f"processor time, nearest {place and (place.body, place.object.name)}")
    if not found.is_free:
        raise SystemExit(f"{found!r}: {[(one.body, one.object.name) for one in found.hits]}")
    return machine, found


def main() -> None:
    """Sweep, and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/machine.png"))
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        machine, found = swept(Path(folder))
    if found.gaps:
        found.gaps.write(out.with_suffix(".svg"))
    canvas = Canvas(VIEW, SIZE, np.array([[0.0, 0.0], SIZE]), np.array(PAPER), 2)
    for kind, tint in GROUPS.items():
        boxes = [
            solids.box(edges) + middle
            for name, edges, middle in parts()
            if name.startswith(kind) and middle[1] < 1.5
        ]
        canvas.fill(np.concatenate(boxes), np.array(tint))
    shown = checked_values(machine, PATH[[0, 2, 4]])
    for n, fade in enumerate((0.6, 0.35, 0.0)):
        for link, surface in machine.surfaces.items():
            pose = machine.placed(shown[n : n + 1], link)[0]
            corners = surface.tree.corners @ pose[:3, :3].T + pose[:3, 3]
            canvas.fill(corners, np.array(TINTS[0]) * (1.0 - fade) + fade)
    picture = canvas.picture()
    values = found.path.at(np.linspace(0.0, found.path.length, 200))
    tips = machine.placed(values, machine.names.index("hand")) @ (0.24, 0.0, 0.0, 1.0)
    line = [(float(x), float(y)) for x, y in canvas.project(tips[:, :3])[:, :2]]
    ImageDraw.Draw(picture).line(line, fill="#242c38", width=2)
    picture.quantize(64).save(out, optimize=True)


if __name__ == "__main__":
    main()
