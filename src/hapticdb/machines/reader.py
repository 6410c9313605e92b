"""Machine files: URDF, with the pairs of an SRDF, or MJCF."""

from dataclasses import replace
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from hapticdb.errors import FileError
from hapticdb.machines.machine import Machine
from hapticdb.machines.urdf import machine_of_urdf
from hapticdb.mesh.text import xml_of

MOST_COPIES = 5000
"""Elements that <replicate> adds. Larger: MuJoCo's time grows with the square, 0.5 s at 3,000."""


def read_machine(path: str | PathLike[str], srdf: str | PathLike[str] | None = None) -> Machine:
    """Machine of a URDF file, or of an MJCF file (extra `machines`).

    srdf : file with the untested pairs of links (`disable_collisions`).

    Raises
    ------
    FileError
        If a file is missing or damaged, a mesh is not in its folder or package, a joint has an
        unsupported kind, or the joints form no tree.
    MissingExtraError
        If MJCF needs `mujoco`.
    """
    root = _xml_root(Path(path))
    if root.tag == "robot":
        machine = machine_of_urdf(Path(path), root)
    elif root.tag == "mujoco":
        from hapticdb.machines.mjcf import machine_of_mjcf  # noqa: PLC0415 - needs an extra

        _check_copies(Path(path), root)
        machine = machine_of_mjcf(Path(path))
    else:
        raise FileError(f"{path}: its root is <{root.tag[:40]}>: give a URDF or MJCF file")
    if not machine.surfaces:
        raise FileError(f"{path}: none of its links has a surface")
    for link, surface in machine.surfaces.items():
        if not np.isfinite(surface.box).all():
            raise FileError(f"{path}: link {machine.names[link]}: a place is not a finite number")
    for joint in machine.joints:
        if not all(np.isfinite(one).all() for one in (joint.origin, joint.axis, joint.point)):
            raise FileError(f"{path}: joint {joint.name}: a place is not a finite number")
    return machine if srdf is None else replace(machine, excluded=_pairs_of(Path(srdf), machine))


def _check_copies(path: Path, root: ET.Element) -> None:
    """Refuse too large a <replicate>, of the file or an included one, by FileError."""
    left, read, total = [(root, 1)], {path}, 0
    while left:
        element, copies = left.pop()
        total += copies - 1
        if total > MOST_COPIES:
            raise FileError(f"{path}: <replicate> adds over {MOST_COPIES:,} elements: give fewer")
        count = element.get("count", "")[:9] if element.tag == "replicate" else ""
        copies *= int(count) if count.isdecimal() else 1
        left.extend((child, copies) for child in element)
        file = path.parent / element.get("file", "")
        if element.tag == "include" and file.is_file() and file not in read:
            read.add(file)
            left.append((_xml_root(file), copies))


def _xml_root(path: Path) -> ET.Element:
    """Root of an XML file; FileError."""
    try:
        return ET.fromstring(xml_of(path.read_bytes()))  # noqa: S314 - expat limits entities
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from error
    except (ET.ParseError, ValueError) as error:
        raise FileError(f"{path} is no XML: {error}") from error


def _pairs_of(path: Path, machine: Machine) -> frozenset[frozenset[str]]:
    """Pairs of links of an SRDF file; FileError if none is of the machine."""
    found = {
        frozenset((one.get("link1", ""), one.get("link2", "")))
        for one in _xml_root(path).iter("disable_collisions")
    }
    known = frozenset(pair for pair in found if pair <= set(machine.names))
    if not known:
        raise FileError(f"{path}: no disable_collisions of links of {machine.file}")
    return known
