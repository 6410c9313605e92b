"""3MF: one part for each build item and component, named by its object path.

trimesh is not used: it stops without an error after (edges times nodes) steps, so nested assemblies
lose instances, and keeps one of two build items of the same part number.
"""

import array
import posixpath
import re
import zipfile
import zlib
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree as ET
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.srgb import PLAIN
from hapticdb.mesh.parsed import (
    Parsed,
    Placement,
    Shape,
    UnreadableError,
    count_note,
    numbers,
    require,
    walk,
)

_METRES = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}
_PIECE = 1 << 20
_HARMLESS = re.compile("/(material|production|trianglesets)/")
_KNOWN = re.compile(f"{_HARMLESS.pattern}|/(beamlattice|slice)/")
"""Also extensions without effect on meshes, reported as unread. A model that requires another one
is refused, as demanded by 3MF's core specification (3.4, Model)."""
_SETTINGS = ("metadata/slic3r_pe_model.config", "metadata/model_settings.config")
_MODIFIER = re.compile(
    rb'\b(?:value|subtype)="'
    rb'(NegativeVolume|ParameterModifier|Support\w+|(?:negative|modifier)_part|support_\w+)"'
)
"""Kinds of volumes other than models, in the settings files of slicers in the archive."""
_EXTENSION = re.compile(r"/([^/]+)/\d{4}/\d{2}$")
Key = tuple[str, str]
"""An object: its model file in the archive, and its id in that file."""
Link = tuple[Key, NDArray[np.float64]]


@dataclass
class _Object:
    """One object of a 3MF model: a mesh, or components."""

    name: str
    group: str = ""
    """Id of its colour group."""
    corners: "array.array[float]" = field(default_factory=lambda: array.array("d"))
    indices: "array.array[int]" = field(default_factory=lambda: array.array("q"))
    components: list[Link] = field(default_factory=list)
    paints: "array.array[int]" = field(default_factory=lambda: array.array("q"))
    """Index of each triangle's colour in `_Model.colours`; -1 without one."""


@dataclass
class _Model:
    """All model files of an archive needed by the build."""

    objects: dict[Key, _Object] = field(default_factory=dict)
    items: list[Link] = field(default_factory=list)
    placed: set[Key] = field(default_factory=set)
    """Objects reachable from the build."""
    metres: float = 1e-3
    colours: list[tuple[int, ...]] = field(default_factory=list)
    number_of: dict[tuple[str, str, str], int] = field(default_factory=dict)
    """Colour indices by model file, group and index in the group."""
    types: Counter[str] = field(default_factory=Counter)
    """Numbers of objects other than models, by type."""
    unread: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """Numbers of unread elements, by extension and name."""

    def links(self) -> list[Link]:
        """All placements by the build and by components."""
        return [*self.items, *(c for thing in self.objects.values() for c in thing.components)]

    def notes(self) -> list[str]:
        """Notes of content not read, or read otherwise than meant."""
        outside = sum(
            bool(thing.indices) and key not in self.placed for key, thing in self.objects.items()
        )
        notes = count_note(outside, "object{s} {are} not in its build and {are} left out")
        for kind, n in self.types.items():
            words = "object{s} {are} of the type {kind}, and {come} in like any other"
            notes += count_note(n, words, kind=kind)
        for extension, elements in self.unread.items():
            most = ", ".join(f"{n} {kind}" for kind, n in elements.most_common(3))
            notes.append(f"its extension {extension} is not read: {most}")
        return notes


def read(path: Path) -> Parsed:
    """Parts of a 3MF file's build, in its unit (millimetres without one)."""
    try:
        with zipfile.ZipFile(path) as archive:
            model = _read_archive(archive)
    except zipfile.BadZipFile:
        raise UnreadableError("it is no 3MF file, or cut short: not a ZIP archive") from None
    shapes: dict[Key, int] = {}
    placements: list[Placement] = []
    for keys, world_from_object in walk(model.items, lambda key: model.objects[key].components):
        thing = model.objects[keys[-1]]
        model.placed.add(keys[-1])
        if thing.components and not thing.indices:
            continue
        names = [model.objects[key].name for key in keys]
        number = shapes.setdefault(keys[-1], len(shapes))
        placements.append(Placement("/".join(names), number, world_from_object))
    read_shapes = [_shape(model.objects[key], model.colours) for key in shapes]
    return Parsed(read_shapes, placements, model.metres, up="z", notes=model.notes())


def _root(archive: zipfile.ZipFile, members: dict[str, str]) -> str:
    """Name of the root model, from the archive's relationships, or else the usual one."""
    usual = "3d/3dmodel.model"
    content = _beside(archive, members.get("_rels/.rels"))
    try:
        links = ET.fromstring(content)  # noqa: S314 - expat stops entities that multiply
    except ET.ParseError:
        return usual
    targets = [one.get("Target", "") for one in links if one.get("Type", "").endswith("/3dmodel")]
    return _member(targets[0]) if targets else usual


def _beside(archive: zipfile.ZipFile, name: str | None) -> bytes:
    """Content of a small member of the archive; empty if unreadable or above `_PIECE`."""
    with suppress(zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError):
        if name is not None and archive.getinfo(name).file_size <= _PIECE:
            return archive.read(name)
    return b""


def _member(name: str) -> str:
    """Canonical name of a member: programs differ in escapes and in upper and lower case."""
    return posixpath.normpath(unquote(name).replace("\\", "/")).lower().strip("/")


def _read_archive(archive: zipfile.ZipFile) -> _Model:
    """Root model, and the models of its components."""
    members = {_member(name): name for name in archive.namelist()}
    root = _root(archive, members)
    if root not in members:
        models = [name for name in archive.namelist() if name.lower().endswith(".model")]
        if not models:
            raise UnreadableError("it is no 3MF file: a ZIP archive without a model in it")
        raise UnreadableError(f"its root model {root} is missing; {models[0]} is in it")
    model = _Model()
    for settings in _SETTINGS:
        found = _MODIFIER.findall(_beside(archive, members.get(settings)))
        model.types.update(kind.decode() for kind in found)
    waiting, seen = [root], {root}
    while waiting:
        member = waiting.pop()
        _read_model(archive, members[member], member, model, is_root=member == root)
        for name in sorted({key[0] for key, _ in model.links()} - seen):
            if name not in members:
                raise UnreadableError(f"it refers to {name}, which is not in the archive")
            waiting.append(name)
            seen.add(name)
    for key, _ in model.links():
        if key not in model.objects:
            raise UnreadableError(f"it places object {key[1]}, which is not defined")
    return model


def _read_model(
    archive: zipfile.ZipFile, name: str, member: str, model: _Model, *, is_root: bool
) -> None:
    """Add one model file's objects, and the root's build items, to `model`."""
    parser = expat.ParserCreate(namespace_separator=" ")
    thing, own, group, n_group = _Object(""), -1, "", 0
    core: str | None = None  # namespace of the first element

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal thing, own, group, n_group, core
        space, _, kind = tag.rpartition(" ")
        core = space if core is None else core
        if space != core and not _HARMLESS.search(space):
            extension = _EXTENSION.search(space)
            model.unread[extension[1] if extension else space][kind] += 1
        elif kind == "vertex":
            x, y, z = attributes["x"], attributes["y"], attributes["z"]
            thing.corners.extend((float(x), float(y), float(z)))
        elif kind == "triangle":
            thing.indices.extend(_index(attributes[v]) for v in ("v1", "v2", "v3"))
            paint = member, attributes.get("pid", thing.group), attributes.get("p1", "")
            thing.paints.append(model.number_of.get(paint, own))
        elif kind == "component":
            thing.components.append(_link(attributes, member))
        elif kind == "object":
            number = attributes["id"]
            thing = _Object(attributes.get("name") or f"object {number}")
            model.objects[member, number] = thing
            if (of_type := attributes.get("type", "model")) != "model":
                model.types[of_type] += 1
            thing.group = attributes.get("pid", "")
            own = model.number_of.get((member, thing.group, attributes.get("pindex", "0")), -1)
        elif kind in {"basematerials", "colorgroup"}:
            group, n_group = attributes.get("id", ""), 0
        elif kind in {"base", "color"}:
            model.number_of[member, group, str(n_group)] = len(model.colours)
            model.colours.append(_colour(attributes.get("displaycolor", attributes.get("color"))))
            n_group += 1
        elif kind == "item" and is_root:
            model.items.append(_link(attributes, member))
            model.types["not printable"] += attributes.get("printable") == "0"
        elif kind == "model":
            for prefix in attributes.get("requiredextensions", "").split():
                name = named.get(prefix, prefix)
                require(_KNOWN.search(name) is not None, f"3MF extension {name}")
            if is_root:
                model.metres = _metres(attributes.get("unit", "millimeter"))

    parser.StartElementHandler = start
    named: dict[str, str] = {}
    parser.StartNamespaceDeclHandler = named.__setitem__
    try:
        with archive.open(name) as stream:
            parser.ParseFile(stream)
    except expat.ExpatError as error:
        raise UnreadableError(f"its model is damaged or cut short: {error}") from None


def _metres(unit: str) -> float:
    """Length of a 3MF unit, metres."""
    if unit not in _METRES:
        raise UnreadableError(f"its unit '{unit}' is none of {', '.join(_METRES)}")
    return _METRES[unit]


def _index(word: str) -> int:
    """Vertex index; -1, out of range, for a negative or huge one."""
    value = int(word)
    return value if 0 <= value < 2**62 else -1


def _link(attributes: dict[str, str], member: str) -> Link:
    """Object and transform of a component or build item."""
    file = next((v for k, v in attributes.items() if k.endswith(" path")), member)
    key = (_member(file), attributes["objectid"])
    transform = np.eye(4)
    words = attributes.get("transform")
    if words is not None:
        values = numbers(words, np.float64)
        if values.size != 12:
            raise UnreadableError("a transform has other than twelve numbers")
        # Row vectors: a point's row times this (4, 3).
        transform[:3, :] = np.asarray(values, dtype=np.float64).reshape(4, 3).T
    return key, transform


def _colour(word: str | None) -> tuple[int, ...]:
    """Red, green, blue and opacity of '#RRGGBB' or '#RRGGBBAA'; `PLAIN` for anything else."""
    try:
        channels = bytes.fromhex((word or "").lstrip("#"))
    except ValueError:
        channels = b""
    return (*channels, 255)[:4] if len(channels) in (3, 4) else PLAIN


def _shape(thing: _Object, colours: list[tuple[int, ...]]) -> Shape:
    """Shape of an object's mesh."""
    corners = np.frombuffer(thing.corners, dtype=np.float64) if thing.corners else np.empty(0)
    indices = np.frombuffer(thing.indices, dtype=np.int64) if thing.indices else np.empty(0, int)
    paints = np.array(thing.paints, dtype=np.int64)
    painted = None
    if len(paints) and paints.max() >= 0:
        painted = np.array([*colours, PLAIN], dtype=np.uint8)[paints]
    return Shape(corners.reshape(-1, 3), indices.reshape(-1, 3), colours=painted)
