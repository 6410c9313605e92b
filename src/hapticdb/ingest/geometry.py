"""Stored objects: geometry from the surfaces in the database, and rows of the index."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hapticdb.errors import FileError, UsageError
from hapticdb.ingest.layout import Bricks, bricks_of_rows, merged
from hapticdb.mesh import Part, surface_packing
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object, Rows, Store, joined
from hapticdb.store.covering import Ranges, object_ranges
from hapticdb.store.parsing import damaged

AT_ONCE = 16
"""Surfaces of one statement. A larger value needs fewer statements and more memory."""
MOST_BYTES = 1_000_000_000
"""Greatest packed surface, bytes, that each engine can store in a row."""
MOST_ROWS = 1 << 19
"""Most rows of the index in one statement, far less than a second's work."""


def parts_of(store: Store, objects: Sequence[Object]) -> Iterator[tuple[Object, Part]]:
    """Yield objects, in their order, with their geometry; DamagedError for an object without.

    A surface is read once, and stays in memory up to its last object.
    """
    uses = Counter(obj.digest for obj in objects)
    requested: set[str] = set()
    packed: dict[str, bytes] = {}
    shapes: dict[str, Part] = {}
    for at, obj in enumerate(objects):
        digest = obj.digest
        if digest not in requested:
            ahead = {later.digest for later in objects[at : at + AT_ONCE]} - requested
            packed |= store.surfaces(sorted(ahead))
            requested |= ahead
        if digest not in shapes:
            shapes[digest] = unpacked_part(store.url, obj, packed.pop(digest, None))
        shape = shapes[digest]
        uses[digest] -= 1
        if not uses[digest]:
            del shapes[digest]
        yield obj, replace(shape, name=obj.name, world_from_part=obj.transform)


def unpacked_part(url: str, obj: Object, surface: bytes | None) -> Part:
    """Geometry of an object from its packed surface; DamagedError if its digest differs."""
    if surface is None:
        raise damaged(url, f"object {obj.id} ({obj.name}) has no surface")
    try:
        vertices, faces, colours, chord = surface_packing.unpack(surface)
    except ValueError as error:
        raise damaged(url, f"object {obj.id}: {error}") from None
    part = Part(obj.name, vertices, faces, obj.transform, colours=colours, chord=chord)
    if part.digest != obj.digest:
        raise damaged(url, f"object {obj.id}: its surface is not the one that was written")
    return part


def packed_surface(part: Part) -> bytes:
    """Packed geometry of a part; FileError if too large for a database row."""
    surface = surface_packing.pack(part.vertices, part.faces, part.colours, part.chord)
    if len(surface) > MOST_BYTES:
        raise FileError(
            f"part {part.name!r}: its surface takes {len(surface) / 1e9:.1f} GB packed, and at "
            "most 1 can be stored: divide it into several parts"
        )
    return surface


def shell_of_objects(
    store: Store,
    objects: Sequence[Object],
    points: int | None,
    spacing: float | None,
    seed: int,
    inset: float = 0.0,
) -> PointShell:
    """One shell of several objects at their placements; see `Environment.shell`."""
    if not objects:
        raise UsageError("a shell of no objects: name at least one")
    triangles, chord = [], 0.0
    for obj, part in parts_of(store, sorted(objects, key=lambda obj: obj.id)):
        if part.is_cloud:
            raise UsageError(
                f"object {obj.id} ({obj.name}) is a point cloud, which has no surface: leave it out"
            )
        triangles.append(part.triangles(obj.transform))
        chord = max(chord, part.placed_chord)
    corners = np.concatenate(triangles).reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    shell = PointShell.from_mesh(corners, faces, points, spacing=spacing, seed=seed, inset=inset)
    return replace(shell, chord=chord)


def rows_of_object(
    store: Store, obj: Object, quantiles: QuantileVector, *, distances: bool = False
) -> Iterator[Rows]:
    """All rows of an object in batches, ascending by key; a statement for each batch."""
    ranges = object_ranges(store.grid, store.layout, obj)
    return _batches(store, obj, ranges, quantiles, distances=distances)


def bricks_of_batches(store: Store, batches: list[Rows], *, distances: bool) -> Bricks:
    """Bricks of batches of rows of one object, with distances if these were read."""
    if store.layout == "brick":
        return bricks_of_rows(joined(batches, distances=distances), store.grid, "brick")
    return merged([bricks_of_rows(batch, store.grid, "voxel") for batch in batches])


def _batches(
    store: Store, obj: Object, ranges: Ranges, quantiles: QuantileVector, *, distances: bool
) -> Iterator[Rows]:
    lows, highs = ranges
    is_one_key = len(lows) == 1 and lows[0] == highs[0]
    pairs = zip(lows.tolist(), highs.tolist(), strict=True)
    if is_one_key or sum(quantiles.rows_between(low, high) for low, high in pairs) <= MOST_ROWS:
        yield store.rows_of(obj.id, lows, highs, distances=distances)
        return
    half = len(lows) // 2
    if half:
        halves = (lows[:half], highs[:half]), (lows[half:], highs[half:])
    else:
        middle = (lows + highs) // 2
        halves = (lows, middle), (middle + 1, highs)
    for part in halves:
        yield from _batches(store, obj, Ranges(*part), quantiles, distances=distances)
