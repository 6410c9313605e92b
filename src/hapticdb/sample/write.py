"""The sample as files: car.glb, wrench.stl and path.csv."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial

from hapticdb.errors import FileError, UsageError
from hapticdb.poses import write_poses
from hapticdb.sample.car import build_car
from hapticdb.sample.parts import SamplePart
from hapticdb.sample.path import slide_path
from hapticdb.sample.shapes import Mesh
from hapticdb.sample.wrench import build_wrench


class SampleFiles(NamedTuple):
    """Where the sample was written."""

    car: Path
    wrench: Path
    path: Path


def car_scene(parts: list[SamplePart]) -> trimesh.Scene:
    """The parts as a scene: a node for each name, under nodes for the groups of its path.

    Node names are unique in the whole scene, as trimesh asks: a part's last name is. Parts that
    share a mesh share a geometry.
    """
    scene = trimesh.Scene()
    geometries: dict[int, str] = {}
    groups: set[str] = set()
    for part in parts:
        *path, leaf = part.name.split("/")
        parent = scene.graph.base_frame
        for group in path:
            if group not in groups:
                scene.graph.update(frame_from=parent, frame_to=group, matrix=np.eye(4))
                groups.add(group)
            parent = group
        if id(part.mesh) not in geometries:
            geometries[id(part.mesh)] = leaf
            scene.geometry[leaf] = _geometry(part)
        scene.graph.update(
            frame_from=parent,
            frame_to=leaf,
            matrix=part.world_from_part,
            geometry=geometries[id(part.mesh)],
        )
    return scene


def _geometry(part: SamplePart) -> trimesh.Trimesh:
    material = PBRMaterial(
        baseColorFactor=[*(round(255 * value) for value in part.color), 255],
        metallicFactor=0.2,
        roughnessFactor=0.6,
    )
    return trimesh.Trimesh(
        part.vertices,
        part.faces,
        process=False,
        visual=trimesh.visual.TextureVisuals(material=material),
    )


def _say_up(tree: dict[str, Any]) -> None:
    """Say in the file that z is up, where the format's y is expected."""
    tree["asset"]["extras"] = {"up_axis": "z"}


def _write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)


def write_wrench(folder: Path, scale: float = 1.0) -> Path:
    """Write wrench.stl, metres, into a folder; 0.25 m long at scale 1."""
    mesh: Mesh = build_wrench()
    scaled = trimesh.Trimesh(mesh.vertices * scale, mesh.faces, process=False)
    content: bytes = scaled.export(file_type="stl")
    _write(folder / "wrench.stl", content)
    return folder / "wrench.stl"


def write_sample(folder: str | os.PathLike[str], count: int = 1000) -> SampleFiles:
    """Write car.glb, wrench.stl and path.csv (`count` poses) into a folder, made when missing."""
    if count < 1:
        raise UsageError(f"a path of {count} poses: give 1 or more")
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot make the folder {target}: {error.strerror}") from error
    parts = build_car()
    car = car_scene(parts).export(file_type="glb", tree_postprocessor=_say_up)
    _write(target / "car.glb", car)
    wrench = write_wrench(target)
    write_poses(target / "path.csv", slide_path(parts, build_wrench().vertices, count))
    return SampleFiles(target / "car.glb", wrench, target / "path.csv")
