"""Records of a store as bodies of messages, and back: for the server and its client."""

import hashlib
import json
import re
from collections.abc import Mapping

import numpy as np

from hapticdb.errors import ProtocolError
from hapticdb.grid import Grid
from hapticdb.protocol.cells import ChangeBody, ObjectBody, RowsBody, WelcomeBody
from hapticdb.store import believed
from hapticdb.store.base import (
    BRICK_BYTES,
    NO_OCCUPANCY,
    Change,
    Layout,
    Object,
    Rows,
    Store,
)

FOLDERS = re.compile(r"^.*[/\\]", re.DOTALL)
"""What stands before a file's name, on any system."""
LOOKS_LIKE_A_PATH = re.compile(r"^\s*(?:/|~|\\|[A-Za-z]:[/\\]|file:)")
"""Begin of a text that may be a path of the server's machine."""


def welcome_body(store: Store, beat: float) -> WelcomeBody:
    """Tell of an opened environment; its identity as a digest, which tells nothing more."""
    grid = store.grid
    identity = hashlib.blake2b(repr(store.identity).encode(), digest_size=16).digest()
    return WelcomeBody(
        grid.voxel_size,
        (grid.origin[0], grid.origin[1], grid.origin[2]),
        grid.bits,
        grid.curve,
        store.layout,
        store.wants_distances,
        identity,
        beat,
        file_name(store.name),
        store.engine,
    )


def grid_of_welcome(url: str, body: WelcomeBody) -> tuple[Grid, Layout]:
    """Grid and layout of a server's environment, checked as those of a file are."""
    numbers = (body.voxel_size, *body.origin, body.bits, body.curve, body.layout)
    return believed.grid_of(url, [numbers])


def file_name(link: str) -> str:
    """Name of a file without its folders."""
    return FOLDERS.sub("", link)


def object_body(obj: Object) -> ObjectBody:
    """Give an object as it is sent: without folders of the server's machine."""
    attributes = {key: value for key, value in obj.attributes.items() if not _is_path(value)}
    crcs = {believed.ROWS_CRC: obj.rows_crc, believed.DISTANCES_CRC: obj.distances_crc}
    kept = {name: f"{crc:016x}" for name, crc in crcs.items() if crc is not None}
    return ObjectBody(
        obj.id,
        obj.revision,
        obj.voxels,
        obj.transform.reshape(16),
        obj.bounds.reshape(6),
        obj.name,
        file_name(obj.link),
        obj.digest,
        json.dumps(attributes | kept, sort_keys=True),
    )


def _is_path(value: object) -> bool:
    """Whether an attribute is, or holds, a text that may be a path."""
    if isinstance(value, str):
        return LOOKS_LIKE_A_PATH.match(value) is not None
    if isinstance(value, Mapping):
        return any(map(_is_path, value.values()))
    return isinstance(value, (list, tuple)) and any(map(_is_path, value))


def object_of_body(url: str, body: ObjectBody) -> Object:
    """Read an object, checked as those of a file are."""
    transform, bounds = body.transform.tobytes(), body.bounds.tobytes()
    texts = body.name, body.link, body.digest
    row = (body.object_id, *texts, transform, body.voxels, bounds, body.attributes, body.revision)
    return believed.object_of(url, row)


def change_body(change: Change) -> ChangeBody:
    """Give a change as it is sent."""
    return ChangeBody(change.revision, change.id, change.action, change.ranges)


def change_of_body(url: str, body: ChangeBody) -> Change:
    """Read a change, checked as those of a file are."""
    ranges = body.ranges.tobytes()
    return believed.change_of(url, (body.revision, body.action, body.object_id, ranges))


def rows_body(rows: Rows, resume: int) -> RowsBody:
    """Give rows as they are sent; resume : the first key that they lack, or -1."""
    band = rows.distances
    if band is None:
        return RowsBody(rows.keys, rows.ids, rows.occupancy, resume=resume)
    return RowsBody(rows.keys, rows.ids, rows.occupancy, band.lengths, band.data, resume)


def rows_of_body(url: str, body: RowsBody, layout: Layout, *, distances: bool) -> Rows:
    """Read rows, and refuse some of another kind than was asked for."""
    n_bytes = BRICK_BYTES * len(body.keys) if layout == "brick" else 0
    if len(body.occupancy) != n_bytes or (body.lengths is not None) != distances:
        raise ProtocolError(f"{url}: the server sent rows of another kind than was asked for")
    rows = Rows(body.keys, body.ids, body.occupancy if n_bytes else NO_OCCUPANCY)
    if body.lengths is None or body.data is None:
        return rows
    return rows.having(believed.band_of(url, np.asarray(body.data).tobytes(), body.lengths))
