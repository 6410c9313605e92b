"""IFC through IfcOpenShell (OpenCASCADE): each placed product, in metres, z up."""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import ifcopenshell
import ifcopenshell.geom
import numpy as np
from ifcopenshell import entity_instance
from ifcopenshell.ifcopenshell_wrapper import triangulation
from ifcopenshell.util.element import get_parent

from hapticdb.mesh.chord import MARGIN, coarser_note, measured
from hapticdb.mesh.formats.srgb import PLAIN, rgba
from hapticdb.mesh.parsed import Parsed, Placement, Shape, count_note

_EXCLUDED = {
    "opening": ("IfcFeatureElementSubtraction",),
    "space": ("IfcSpace", "IfcSpatialZone", "IfcVirtualElement"),
}
"""Classes of products without a body of their own; openings are subtracted from their hosts."""
_FACETS = ("IfcTessellatedItem", "IfcFacetedBrep")
"""Classes of representation items of exact polygons."""
_CHORD = 1e-4
"""Greatest chord error unless given, metres. A bend of a pipe of 0.1 m (0.4 m across) has 22,000
triangles and takes 0.2 s; at 1e-5 it has 220,000 and takes 42 s."""
_END = b"END-ISO-10303-21"


def read(path: Path, chord: float = _CHORD) -> Parsed:
    """Products of an IFC file with a shape, with class, GlobalId and storey.

    chord : greatest chord error of curved faces, metres.
    """
    model = ifcopenshell.open(path)
    excluded: Counter[str] = Counter()
    products = list(_products(model, excluded))
    settings = ifcopenshell.geom.settings()
    settings.set("weld-vertices", False)  # noqa: FBT003 - each face has the normals of its surface
    settings.set("mesher-linear-deflection", chord / MARGIN)
    shapes: list[Shape] = []
    numbers: dict[str, int] = {}
    placed = {}
    for one in ifcopenshell.geom.iterator(settings, model, 1, include=products) if products else ():
        number = numbers.setdefault(one.geometry.id, len(shapes))
        if number == len(shapes):
            shapes.append(_shape(model, one.geometry, chord))
        placed[one.id] = number, np.reshape(one.transformation.matrix, (4, 4), order="F")
    named = _named(product for product in products if product.id() in placed)
    placements = [Placement(name, *placed[number], said) for number, name, said in named]
    words = "{what}{s} {are} left out"
    notes = [note for what, n in excluded.items() for note in count_note(n, words, what=what)]
    words = "product{s} {are} left out: lines, or shapes that cannot be made"
    notes += count_note(len(products) - len(placed), words)
    if _END not in path.read_bytes()[-1024:]:
        notes.append(f"it seems cut short: '{_END.decode()}' does not stand at its end")
    notes += coarser_note(shapes, chord)
    return Parsed(shapes, placements, metres=1.0, up="z", notes=notes)


def _products(model: ifcopenshell.file, excluded: Counter[str]) -> Iterator[entity_instance]:
    """Products with a shape, ascending by id; counts the omitted ones by kind."""
    for product in sorted(model.by_type("IfcProduct"), key=entity_instance.id):
        kinds = (what for what, of in _EXCLUDED.items() if any(map(product.is_a, of)))
        if kind := next(kinds, None):
            excluded[kind] += 1
        elif product.Representation:
            yield product


def _named(products: Iterable[entity_instance]) -> Iterator[tuple[int, str, dict[str, str]]]:
    """Id of each product, its name path below the project, and its attributes."""
    parents: dict[int, entity_instance | None] = {}
    for product in products:
        chain = [product]
        while True:
            last = chain[-1].id()
            if last not in parents:
                parents[last] = get_parent(chain[-1])
            parent = parents[last]
            if parent is None or parent in chain or parent.is_a("IfcProject"):
                break
            chain.append(parent)
        name = "/".join(one.Name or one.is_a() for one in reversed(chain))
        said = {"IfcClass": product.is_a(), "GlobalId": product.GlobalId or ""}
        storey = next((one for one in chain if one.is_a("IfcBuildingStorey")), None)
        yield product.id(), name, said | ({"Storey": storey.Name or ""} if storey else {})


def _shape(model: ifcopenshell.file, geometry: triangulation, chord: float) -> Shape:
    """Triangles of a product, with their chord error; chord : the requested one, metres."""
    vertices = np.frombuffer(geometry.verts_buffer).reshape(-1, 3)
    normals = np.frombuffer(geometry.normals_buffer).reshape(-1, 3)
    faces = np.frombuffer(geometry.faces_buffer, np.int32).reshape(-1, 3)
    palette = np.frombuffer(geometry.colors_buffer).reshape(-1, 4)
    colours = None
    if len(palette):
        tints = np.vstack([rgba(palette), np.array([PLAIN], np.uint8)])
        colours = tints[np.frombuffer(geometry.material_ids_buffer, np.int32)]  # -1: the last
    with np.errstate(invalid="ignore"):  # at a pole: no normal
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    items = [model.by_id(number) for number in {*geometry.item_ids}]
    is_exact = all(any(map(item.is_a, _FACETS)) for item in items)  # no border is curved
    shape = Shape(vertices.copy(), faces.copy(), colours=colours, normals=normals)
    return measured(shape, 0.0 if is_exact else chord)
