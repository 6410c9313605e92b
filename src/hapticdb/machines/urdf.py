"""URDF: links, joints, meshes."""

import os
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError
from hapticdb.machines import solids
from hapticdb.machines.machine import FIXED, HINGE, SLIDE, Joint, LinkSurface, Machine
from hapticdb.mesh import read_file
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]

_KINDS = {"revolute": HINGE, "continuous": HINGE, "prismatic": SLIDE, "fixed": FIXED}
_LEVELS = 6
"""Folders above the file, searched for a mesh of a package."""


def machine_of_urdf(path: Path, root: ET.Element) -> Machine:
    """Machine of the root of a URDF file."""
    links = _named(path, root, "link")
    order, above = _tree(path, links, _named(path, root, "joint"))
    meshes: dict[Path, list[tuple[Floats, float]]] = {}
    surfaces, notes = {}, []
    for n, name in enumerate(order):
        for kind in ("collision", "visual"):
            placed = [
                _placed(path, name, one, meshes)
                for one in links[name].findall(kind)
                if one.find("geometry") is not None
            ]
            if placed:
                triangles, chords = zip(*placed, strict=True)
                surfaces[n] = LinkSurface(np.concatenate(triangles), max(chords))
                if kind == "visual":
                    notes.append(name)
                break
    joints = tuple(_joint(path, above[name], order) for name in order[1:])
    remark = [f"links without collision geometry have their visual one: {', '.join(notes)}"]
    return Machine(str(path), tuple(order), surfaces, joints, None, tuple(remark if notes else ()))


def _named(path: Path, root: ET.Element, tag: str) -> dict[str, ET.Element]:
    found = root.findall(tag)
    named = {one.get("name", ""): one for one in found}
    if len(named) < len(found) or "" in named:
        raise FileError(f"{path}: two of its {tag}s have the same name, or one has none")
    return named


def _tree(
    path: Path, links: Mapping[str, ET.Element], joints: Mapping[str, ET.Element]
) -> tuple[list[str], dict[str, ET.Element]]:
    """Names of the links, the base first and parents before children, and the joint above each."""
    above: dict[str, ET.Element] = {}
    below: dict[str, list[str]] = {}
    for name, joint in joints.items():
        ends = [_child(path, joint, tag).get("link", "") for tag in ("parent", "child")]
        for end in ends:
            if end not in links:
                raise FileError(
                    f"{path}: joint {name!r} names the link {end!r}, which is not there"
                )
        if ends[1] in above:
            raise FileError(
                f"{path}: link {ends[1]!r} hangs on two joints, {above[ends[1]].get('name')!r} and "
                f"{name!r}: closed kinematics are not read, leave out one of them"
            )
        above[ends[1]] = joint
        below.setdefault(ends[0], []).append(ends[1])
    order = [name for name in links if name not in above]
    if len(order) != 1:
        remark = ", ".join(order[:3]) or "none, its joints form a circle"
        raise FileError(f"{path}: one link must stand on no joint, the base; there is {remark}")
    for name in order:
        order.extend(below.get(name, ()))
    if len(order) < len(links):
        left = next(name for name in links if name not in order)
        raise FileError(f"{path}: link {left!r} is in a circle of joints: give a tree")
    return order, above


def _child(path: Path, of: ET.Element, tag: str) -> ET.Element:
    found = of.find(tag)
    if found is None:
        raise FileError(f"{path}: {of.tag} {of.get('name', '')!r} has no <{tag}>")
    return found


def _numbers(path: Path, of: ET.Element | None, name: str, default: str, count: int) -> Floats:
    """Finite numbers of an attribute."""
    text = default if of is None else of.get(name, default)
    try:
        found = np.array([float(word) for word in text.split()])
    except ValueError:
        found = np.empty(0)
    if len(found) != count or not np.isfinite(found).all():
        raise FileError(f"{path}: {name}={text[:40]!r}: give {count} number(s)")
    return found


def _origin(path: Path, of: ET.Element) -> Floats:
    """Pose (4, 4) of the <origin>: roll, pitch and yaw about fixed axes."""
    found, pose = of.find("origin"), np.eye(4)
    half = 0.5 * np.diag(_numbers(path, found, "rpy", "0 0 0", 3))
    turns = np.hstack([np.cos(half.sum(axis=1, keepdims=True)), np.sin(half)])
    roll, pitch, yaw = rotation_of(turns)
    pose[:3, :3] = yaw @ pitch @ roll
    pose[:3, 3] = _numbers(path, found, "xyz", "0 0 0", 3)
    return pose


def _joint(path: Path, of: ET.Element, order: list[str]) -> Joint:
    name, kind = of.get("name", ""), of.get("type", "")
    if kind not in _KINDS:
        known = ", ".join(_KINDS)
        raise FileError(f"{path}: joint {name!r} is of the kind {kind[:40]!r}: known are {known}")
    axis = _numbers(path, of.find("axis"), "xyz", "1 0 0", 3)
    length = float(np.abs(axis).max())
    if kind != "fixed" and not length:
        raise FileError(f"{path}: joint {name!r} has an axis without length")
    axis /= length or 1.0
    limit, mimic = of.find("limit"), of.find("mimic")
    low, high = (
        float(_numbers(path, limit if kind != "continuous" else None, side, f"{sign}1e300", 1)[0])
        for side, sign in (("lower", "-"), ("upper", ""))
    )
    parent, child = (
        order.index(_child(path, of, tag).get("link", "")) for tag in ("parent", "child")
    )
    return Joint(
        name, _KINDS[kind], parent, child, _origin(path, of), axis / (np.linalg.norm(axis) or 1.0),
        low=low, high=high, driver="" if mimic is None else mimic.get("joint", ""),
        factor=float(_numbers(path, mimic, "multiplier", "1", 1)[0]),
        offset=float(_numbers(path, mimic, "offset", "0", 1)[0]),
    )  # fmt: skip


def _placed(
    path: Path, link: str, of: ET.Element, meshes: dict[Path, list[tuple[Floats, float]]]
) -> tuple[Floats, float]:
    """Triangles (T, 3, 3) of a <collision> or <visual>, link's frame, and their chord error."""
    geometry, pose = _child(path, of, "geometry"), _origin(path, of)
    chord = 0.0
    for one in geometry:
        if one.tag == "mesh":
            triangles, chord = _mesh(path, link, one, meshes)
        elif one.tag == "box":
            triangles = solids.box(_numbers(path, one, "size", "", 3))
        elif one.tag in {"cylinder", "capsule", "sphere"}:
            radius = float(_numbers(path, one, "radius", "", 1)[0])
            length = 0.0 if one.tag == "sphere" else float(_numbers(path, one, "length", "", 1)[0])
            if not (radius > 0.0 and length >= 0.0):
                raise FileError(f"{path}: link {link!r} has a {one.tag} without size")
            is_flat = one.tag == "cylinder"
            triangles = (solids.cylinder if is_flat else solids.capsule)(radius, length)
        else:
            continue
        return triangles @ pose[:3, :3].T + pose[:3, 3], chord
    raise FileError(f"{path}: link {link!r} has no mesh, box, cylinder, capsule or sphere")


def _mesh(
    path: Path, link: str, of: ET.Element, meshes: dict[Path, list[tuple[Floats, float]]]
) -> tuple[Floats, float]:
    name = of.get("filename", "")
    file = _beside(path, name)
    if file is None:
        raise FileError(
            f"{path}: link {link!r}: its mesh {name[:200]!r} is not beside the file, nor in a "
            "package above it; absolute paths and other addresses are not read"
        )
    if file not in meshes:
        parts = [one for one in read_file(file, unit="m").parts if not one.is_cloud]
        if not parts:
            raise FileError(f"{file}: it has points, but no triangles")
        meshes[file] = [(one.triangles(), one.placed_chord) for one in parts]
    scale = _numbers(path, of, "scale", "1 1 1", 3)
    triangles, chords = zip(*meshes[file], strict=True)
    return np.concatenate(triangles) * scale, max(chords) * float(np.abs(scale).max())


def _beside(path: Path, name: str) -> Path | None:
    """File of a mesh: relative to the URDF file, or of a package in a folder above it."""
    try:
        url = urlsplit(name)
    except ValueError:
        return None
    if url.scheme in {"package", "model"}:
        rest = unquote(url.path.lstrip("/"))
        folders = list(path.resolve().parents)[:_LEVELS]
        places = [one / more for one in folders for more in (Path(url.netloc, rest), Path(rest))]
    elif url.scheme or Path(name).is_absolute():
        return None
    else:
        places = [path.resolve().parent / name, path.resolve().parent / unquote(name)]
    return next((one for one in places if os.path.isfile(one)), None)  # noqa: PTH113 - no error
