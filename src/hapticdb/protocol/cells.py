"""Messages of the endpoint `/device/cells`, to the byte: docs/protocol.md has the layouts.

Each `pack_...` builds the body of a message, and each `..._of` reads one with every length checked.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import ProtocolError
from hapticdb.protocol.fields import FieldsRead, FieldsWritten

MOST_KEYS = 1 << 14
"""Most keys or ranges of one request. Larger: fewer messages for a large shell, longer answers."""
MOST_ROWS = 1 << 15
"""Most rows of an answer. A greater number keeps a client's other requests waiting for longer."""
MOST_REQUEST = 16 * MOST_KEYS + 64
"""Most bytes of a request: the lower and upper ends of the most ranges, and the fields before."""
MOST_ANSWER = 16 << 20
"""Most bytes of an answer that a client accepts. Larger: a server that means harm costs it more."""
BRICK = 64
"""Bytes of a brick's occupancy."""
COMPLETE = -1
"""Where an answer that lacks nothing is continued."""
CURVES = ("lexicographic", "z", "hilbert")
LAYOUTS = ("voxel", "brick")
ACTIONS = ("add", "move", "remove")
HAS_BRICKS, HAS_DISTANCES = 1, 2
"""Bits of the flags of rows and of requests for them."""

Int64s = NDArray[np.int64]
Bytes = NDArray[np.uint8]


class WelcomeBody(NamedTuple):
    """What a server tells a new client about its environment.

    voxel_size, origin : m; bits, curve : of the keys; identity : 16 bytes, other ones for another
    environment; beat : seconds between two BEATs; name, engine : as the server's store has them.
    """

    voxel_size: float
    origin: tuple[float, float, float]
    bits: int
    curve: str
    layout: Literal["voxel", "brick"]
    wants_distances: bool
    identity: bytes
    beat: float
    name: str
    engine: str

    def packed(self) -> bytes:
        """The body of WELCOME."""
        body = FieldsWritten().f8(self.voxel_size, *self.origin)
        codes = CURVES.index(self.curve), LAYOUTS.index(self.layout)
        body.u1(self.bits, *codes, self.wants_distances).u4(round(1000 * self.beat))
        return body.take(self.identity).text(self.name).text(self.engine).joined()


def welcome_of(body: FieldsRead) -> WelcomeBody:
    """Read the body of WELCOME; the caller judges whether there can be such a grid."""
    size, x, y, z = (body.f8() for _ in range(4))
    bits, curve, layout, wish = (body.u1() for _ in range(4))
    if curve >= len(CURVES) or layout >= len(LAYOUTS) or wish > 1:
        raise ProtocolError("a WELCOME with an unknown curve or layout")
    beat, identity = body.u4() / 1000, body.take(16)
    name, engine = body.text(), body.text()
    body.end()
    kind: Literal["voxel", "brick"] = "brick" if layout else "voxel"
    return WelcomeBody(
        size, (x, y, z), bits, CURVES[curve], kind, bool(wish), identity, beat, name, engine
    )


class Asked(NamedTuple):
    """Keys or ranges of a request, ascending and disjoint.

    lows, highs (n,) int64, the same for keys; distances : whether rows come with distances;
    object_id : of ROWS_OF alone.
    """

    lows: Int64s
    highs: Int64s
    distances: bool = False
    object_id: int = 0


def pack_keys(keys: Int64s, *, distances: bool) -> bytes:
    """Body of LOOKUP and LOOKUP_EACH."""
    return _asked(len(keys), distances=distances).array(keys, "<i8").joined()


def keys_of(body: FieldsRead) -> Asked:
    """Read the body of LOOKUP and LOOKUP_EACH."""
    n_keys, distances = _numbers_asked(body)
    keys = body.i8s(n_keys)
    body.end()
    if n_keys and (keys[0] < 0 or (np.diff(keys) <= 0).any()):
        raise ProtocolError("keys that do not ascend, or are below 0")
    return Asked(keys, keys, distances)


def pack_ranges(lows: Int64s, highs: Int64s, *, distances: bool) -> bytes:
    """Body of SCAN and COUNT."""
    body = _asked(len(lows), distances=distances)
    return body.array(lows, "<i8").array(highs, "<i8").joined()


def ranges_of(body: FieldsRead) -> Asked:
    """Read the body of SCAN and COUNT."""
    n_ranges, distances = _numbers_asked(body)
    return _ranges(body, n_ranges, distances=distances)


def pack_rows_of(object_id: int, lows: Int64s, highs: Int64s, *, distances: bool) -> bytes:
    """Body of ROWS_OF."""
    body = _asked(len(lows), distances=distances).i8(object_id)
    return body.array(lows, "<i8").array(highs, "<i8").joined()


def rows_asked_of(body: FieldsRead) -> Asked:
    """Read the body of ROWS_OF."""
    n_ranges, distances = _numbers_asked(body)
    object_id = body.i8()
    return _ranges(body, n_ranges, distances=distances)._replace(object_id=object_id)


def _asked(count: int, *, distances: bool) -> FieldsWritten:
    return FieldsWritten().u4(HAS_DISTANCES if distances else 0, count)


def _numbers_asked(body: FieldsRead) -> tuple[int, bool]:
    flags, count = body.u4(), body.u4()
    if flags & ~HAS_DISTANCES:
        raise ProtocolError(f"unknown flags {flags:#x}")
    if count > MOST_KEYS:
        raise ProtocolError(f"{count} keys or ranges: at most {MOST_KEYS} may be asked for at once")
    return count, bool(flags)


def _ranges(body: FieldsRead, count: int, *, distances: bool) -> Asked:
    lows, highs = body.i8s(count), body.i8s(count)
    body.end()
    if count and (lows[0] < 0 or (lows > highs).any() or (lows[1:] <= highs[:-1]).any()):
        raise ProtocolError("ranges that do not ascend, overlap, or begin below 0")
    return Asked(lows, highs, distances)


class RowsBody(NamedTuple):
    """Rows of an answer.

    keys, ids (R,) int64; occupancy (64 R,) uint8, empty on the layout voxel; lengths (R,) int64 and
    data (n,) uint8 : packed distances, None without; resume : the first key that the answer lacks,
    `COMPLETE` if there is none.
    """

    keys: Int64s
    ids: Int64s
    occupancy: Bytes
    lengths: Int64s | None = None
    data: Bytes | None = None
    resume: int = COMPLETE

    def write(self, body: FieldsWritten) -> FieldsWritten:
        """Append the rows' fields."""
        has_distances = self.lengths is not None
        flags = HAS_BRICKS * bool(self.occupancy.size) | HAS_DISTANCES * has_distances
        body.u4(flags, len(self.keys)).i8(self.resume)
        body.array(self.keys, "<i8").array(self.ids, "<i8").array(self.occupancy, "u1")
        if self.lengths is not None and self.data is not None:
            body.array(self.lengths, "<u2").array(self.data, "u1")
        return body


def rows_of(body: FieldsRead) -> RowsBody:
    """Read the fields of rows; arrays are views that cannot be written, or copies."""
    flags, count, resume = body.u4(), body.u4(), body.i8()
    if flags & ~(HAS_BRICKS | HAS_DISTANCES) or resume < COMPLETE:
        raise ProtocolError(f"rows with unknown flags {flags:#x}, or continued at {resume}")
    keys, ids = body.i8s(count), body.i8s(count)
    occupancy = np.frombuffer(body.take(BRICK * count if flags & HAS_BRICKS else 0), np.uint8)
    if count and (keys[0] < 0 or (np.diff(keys) < 0).any()):
        raise ProtocolError("rows whose keys do not ascend, or are below 0")
    if not flags & HAS_DISTANCES:
        return RowsBody(keys, ids, occupancy, resume=resume)
    lengths = body.array(count, "<u2").astype(np.int64)
    data = np.frombuffer(body.take(int(lengths.sum())), np.uint8)
    return RowsBody(keys, ids, occupancy, lengths, data, resume)


class ChangeBody(NamedTuple):
    """One committed write: action is one of `ACTIONS`; ranges (C, 2) int64, of voxel keys."""

    revision: int
    object_id: int
    action: str
    ranges: Int64s


def write_changes(body: FieldsWritten, changes: Sequence[ChangeBody]) -> FieldsWritten:
    """Append changes after their number."""
    body.u4(len(changes))
    for change in changes:
        body.i8(change.revision, change.object_id)
        body.u4(ACTIONS.index(change.action), len(change.ranges)).array(change.ranges, "<i8")
    return body


def changes_of(body: FieldsRead) -> list[ChangeBody]:
    """Read changes and their number."""
    changes = []
    for _ in range(_count(body, least=24)):
        revision, object_id, action, n_ranges = body.i8(), body.i8(), body.u4(), body.u4()
        if action >= len(ACTIONS):
            raise ProtocolError(f"a change of the unknown action {action}")
        ranges = body.i8s(2 * n_ranges).reshape(-1, 2)
        changes.append(ChangeBody(revision, object_id, ACTIONS[action], ranges))
    return changes


class ObjectBody(NamedTuple):
    """One object. `link` has no folder; transform (16,), bounds (6,) float64; attributes : JSON."""

    object_id: int
    revision: int
    voxels: int
    transform: NDArray[np.float64]
    bounds: NDArray[np.float64]
    name: str
    link: str
    digest: str
    attributes: str

    def packed(self) -> bytes:
        """The object's fields."""
        body = FieldsWritten().i8(self.object_id, self.revision, self.voxels)
        body.array(self.transform, "<f8").array(self.bounds, "<f8")
        texts = self.name, self.link, self.digest, self.attributes
        for text in texts:
            body.text(text)
        return body.joined()


def write_objects(body: FieldsWritten, packed: Sequence[bytes]) -> FieldsWritten:
    """Append packed objects after their number."""
    return body.u4(len(packed)).take(b"".join(packed))


def objects_of(body: FieldsRead) -> list[ObjectBody]:
    """Read objects and their number."""
    objects = []
    for _ in range(_count(body, least=216)):
        object_id, revision, voxels = body.i8(), body.i8(), body.i8()
        transform, bounds = body.f8s(16), body.f8s(6)
        texts = body.text(), body.text(), body.text(), body.text()
        objects.append(ObjectBody(object_id, revision, voxels, transform, bounds, *texts))
    return objects


def _count(body: FieldsRead, least: int) -> int:
    """Read a number of entries, refused if so many of the least size are longer than the rest."""
    count = body.u4()
    if count * least > body.left:
        raise ProtocolError(f"{count} entries announced in {body.left} bytes")
    return count


class NewsBody(NamedTuple):
    """What has changed since the last NEWS, pushed by the server.

    since : revision of the last NEWS; has_all : whether `changes` has every write since then;
    changes, objects : the writes, and the objects that they wrote; cells (n,) int64 : keys of cells
    on the curve, ascending, whose rows are `rows`; these were asked for before, and are touched.
    """

    since: int
    has_all: bool
    changes: Sequence[ChangeBody]
    objects: Sequence[ObjectBody]
    cells: Int64s
    rows: RowsBody

    def packed(self) -> bytes:
        """The body of NEWS."""
        body = FieldsWritten().i8(self.since).u4(self.has_all)
        write_changes(body, self.changes)
        write_objects(body, [obj.packed() for obj in self.objects])
        body.u4(len(self.cells)).array(self.cells, "<i8")
        return self.rows.write(body).joined()


def news_of(body: FieldsRead) -> NewsBody:
    """Read the body of NEWS."""
    since, has_all = body.i8(), body.u4()
    changes, objects = changes_of(body), objects_of(body)
    cells = body.i8s(body.u4())
    rows = rows_of(body)
    body.end()
    if has_all > 1 or (len(cells) and (cells[0] < 0 or (np.diff(cells) <= 0).any())):
        raise ProtocolError("NEWS with unknown flags, or cells that do not ascend")
    return NewsBody(since, bool(has_all), changes, objects, cells, rows)


def pack_numbers(*values: int) -> bytes:
    """Body of NUMBERS, and of requests with numbers alone."""
    return FieldsWritten().u4(len(values)).i8(*values).joined()


def numbers_of(body: FieldsRead, count: int) -> list[int]:
    """Read `count` numbers and their number."""
    found = body.u4()
    if found != count:
        raise ProtocolError(f"{found} numbers instead of {count}")
    values: list[int] = body.i8s(count).tolist()
    body.end()
    return values
