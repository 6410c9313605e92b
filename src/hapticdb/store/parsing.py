"""Validation of all values from an environment's tables, common to all engines.

An environment may be damaged or malicious. Every value, apart from the rows of the index, gets the
right type within its bounds here, or a DamagedError with its location.
"""

import json
import math
import sys
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, pairwise, repeat
from typing import Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from hapticdb.array_types import Floats
from hapticdb.errors import DamagedError, GridError
from hapticdb.grid import CurveName, Grid
from hapticdb.kernels.field import occupancy
from hapticdb.store.base import (
    LAYOUTS,
    LONGEST_BAND,
    Band,
    Change,
    Histogram,
    Keys,
    Layout,
    Object,
    Rows,
)
from hapticdb.store.pairs import SAYS, STATUSES, Outlines, PairRow, Rule
from hapticdb.store.store_errors import made_before
from hapticdb.verdicts import Kind

KEY_END = 1 << 63
"""Upper bound of counts and keys: int64."""
ROWS_CRC = "rows_crc"
"""Attribute with the checksum of an object's rows."""
DISTANCES_CRC = "distances_crc"
"""Attribute with the checksum of an object's distances."""
CHECKSUMS = (ROWS_CRC, DISTANCES_CRC)
ACTIONS = ("add", "move", "remove")
"""Actions in a row of `change`."""
TABLES = (
    "brick", "change", "cost", "environment", "object", "pair", "quantile", "removed", "rule",
    "surface", "voxel",
)  # fmt: skip
"""Tables of every environment."""
NO_VOXEL = bytes(8)
"""Packed occupancy of a brick without a voxel of the object, left out in the tables."""


def damaged(url: str, cause: str) -> DamagedError:
    """Build the error for an environment with broken contents."""
    return DamagedError(f"{url} is damaged ({cause}): restore a copy or import the files again")


def cause_of(error: DamagedError) -> str:
    """Text between the brackets of a message, for a report that names the environment itself."""
    text = str(error)
    start, end = text.find("is damaged ("), text.rfind("): ")
    return text[start + len("is damaged (") : end] if 0 <= start < end else text


class Checksum:
    """CRC-32 of an object's keys, and of its bricks or distances, over its rows in order of keys.

    With distances, keys and lengths count as pairs, so no byte can move to the next row.
    """

    __slots__ = ("_contents", "_keys")

    def __init__(self) -> None:
        self._keys = self._contents = 0

    def add(self, rows: Rows) -> None:
        """Add the next rows: their distances, or without any their bricks."""
        keys, contents = rows.keys, rows.occupancy
        if rows.distances is not None:
            # with lengths: else a byte could move to the next row without a change of the CRC
            keys = np.stack([keys, rows.distances.lengths], axis=1)
            contents = rows.distances.data
        # little-endian on every machine: copies compare these sums
        self._keys = zlib.crc32(np.ascontiguousarray(keys, "<i8").data, self._keys)
        if contents.size:
            self._contents = zlib.crc32(np.ascontiguousarray(contents).data, self._contents)

    def value(self) -> int:
        """Checksum of all rows so far: CRC of the keys << 32 | CRC of the contents."""
        return self._keys << 32 | self._contents


def rows_crc(rows: Rows) -> int:
    """Checksum of all rows of an object."""
    checksum = Checksum()
    checksum.add(rows)
    return checksum.value()


def distances_crc(rows: Rows) -> int | None:
    """Checksum of all distances of an object; None if it has none."""
    return None if rows.distances is None else rows_crc(rows)


def attributes_text(record: Object, rows: Rows) -> str:
    """An object's attributes as JSON, with the checksums of its rows."""
    kept = {**record.attributes, ROWS_CRC: f"{rows_crc(rows.occupied()):016x}"}
    kept.pop(DISTANCES_CRC, None)
    crc = distances_crc(rows)
    if crc is not None:
        kept[DISTANCES_CRC] = f"{crc:016x}"
    return json.dumps(kept, sort_keys=True)


def check_lengths(url: str, most: int) -> None:
    """Refuse rows of distances of more bytes than `LONGEST_BAND`."""
    if most > LONGEST_BAND:
        raise damaged(url, "distances of the wrong length")


def band_of(url: str, packed: bytes, lengths: NDArray[np.int64]) -> Band:
    """Packed distances from a read, with the bytes of each row; DamagedError if they differ."""
    check_lengths(url, lengths.max(initial=0))
    ends = np.cumsum(lengths)
    if len(packed) != (int(ends[-1]) if len(ends) else 0):
        raise damaged(url, "distances of the wrong length")
    return Band(np.frombuffer(packed, np.uint8), ends)


def bricks_of(url: str, packed: bytes, count: int) -> NDArray[np.uint8]:
    """Occupancy of bricks from their packed concatenation."""
    try:
        return occupancy.unpack(packed, count)
    except ValueError as error:
        raise damaged(url, "a brick of the wrong length") from error


def fields_of(rows: Rows) -> Iterator[tuple[bytes | None, bytes | None]]:
    """Fields of bricks for the tables: packed occupancy and distances, None without any."""
    bricks = occupancy.pack(rows.occupancy)
    if rows.distances is None:
        return zip(_pieces(*bricks), repeat(None))
    return zip(_pieces(*bricks), _pieces(*rows.distances), strict=True)


def _pieces(data: NDArray[np.uint8], ends: NDArray[np.int64]) -> Iterator[bytes | None]:
    joined = data.tobytes()
    for start, end in pairwise(chain([0], ends.tolist())):
        yield joined[start:end] or None


def distances_wanted(url: str, stored: object) -> bool:
    """Whether imports compute distances, from a number 0 or 1, or a boolean."""
    if stored not in {0, 1}:
        raise damaged(url, "whether it wants distances is neither yes nor no")
    return bool(stored)


def grid_of(url: str, rows: Sequence[Sequence[Any]]) -> tuple[Grid, Layout]:
    """Grid and layout, from (voxel_size, x, y, z, bits, curve, layout) of `environment`."""
    if len(rows) != 1:
        raise damaged(url, "no grid" if not rows else f"{len(rows)} grids")
    size, x, y, z, bits, curve, layout = rows[0][:7]
    if layout not in LAYOUTS:
        raise damaged(url, f"no grid of layout {layout!r:.40}")
    if layout == "brick" and curve == "lexicographic":
        raise damaged(url, "bricks in lexicographic order")
    # `type`, since a bool is an int to isinstance
    if type(bits) is not int or not all(type(a) in {int, float} for a in (size, x, y, z)):
        raise damaged(url, "a grid that is no numbers")
    try:
        return Grid(size, (x, y, z), bits, cast("CurveName", curve)), cast("Layout", layout)
    except (GridError, TypeError, OverflowError) as error:
        raise damaged(url, f"a grid that cannot be: {error}") from error


def check_tables(url: str, kinds: Mapping[str, str]) -> None:
    """Refuse an environment with a missing table, or a view instead: a view can return anything.

    kinds : ``table``, or another kind of object, by name.
    """
    if "band" in kinds:  # an older format: distances had a table
        raise made_before(url)
    for name in TABLES:
        kind = kinds.get(name)
        if kind is None:
            raise damaged(url, f"no such table: {name}")
        if kind != "table":
            raise damaged(url, f"{name} is a {kind} and no table")


def object_of(url: str, row: Sequence[Any]) -> Object:
    """Parse an object: id, name, link, digest, transform, voxels, bounds, attributes, revision.

    Arrays of doubles are little-endian bytes or a list.
    """
    object_id, name, link, digest, transform, voxels, bounds, attributes, revision = row

    def refuse(what: str) -> NoReturn:
        raise damaged(url, f"object {object_id!s:.40}: {what}")

    if not _is_count(object_id) or object_id < 1:
        refuse("its id is no number above 0")
    if not all(isinstance(text, str) for text in (name, link, digest)):
        refuse("its name, link or digest is no text")
    if not _is_count(voxels) or not _is_count(revision):
        refuse("its voxels or its revision is no count")
    placed = _doubles(transform, 16)
    if placed is None:
        refuse("its transform is no 16 finite numbers")
    corners = _doubles(bounds, 6)
    if corners is None or (corners[:3] > corners[3:]).any():
        refuse("its bounds are no box")
    known = _json_of(attributes)
    if known is None:
        refuse("its attributes are no JSON object")
    return Object(
        id=object_id,
        name=name,
        link=link,
        digest=digest,
        transform=placed.reshape(4, 4),
        voxels=voxels,
        bounds=corners.reshape(2, 3),
        attributes={key: value for key, value in known.items() if key not in CHECKSUMS},
        revision=revision,
        rows_crc=_crc_of(known.get(ROWS_CRC)),
        distances_crc=_crc_of(known.get(DISTANCES_CRC)),
    )


def outlines_of(url: str, rows: Sequence[Sequence[Any]]) -> Outlines:
    """Parse summary rows: name, digest, id, revision, bounds as bytes or as a list."""
    names, digests, ids, revisions, bounds = zip(*rows, strict=True) if rows else ((),) * 5
    try:
        if set(map(type, (*ids, *revisions))) - {int} or set(map(type, (*names, *digests))) - {str}:
            raise TypeError  # noqa: TRY301 - caught below
        numbers = np.array((ids, revisions), dtype=np.int64)
        if set(map(type, bounds)) == {bytes} and set(map(len, bounds)) == {48}:
            boxes = np.frombuffer(b"".join(bounds), dtype="<f8")
        else:
            boxes = np.array(bounds, dtype=np.float64)
        boxes = boxes.reshape(-1, 2, 3)
        if not (boxes[:, 0] <= boxes[:, 1]).all() or not np.isfinite(boxes).all():
            raise ValueError  # noqa: TRY301 - caught below
    except (TypeError, ValueError, OverflowError):
        raise damaged(url, "names, digests, ids, revisions or bounds of its objects") from None
    return Outlines(names, digests, numbers[0], numbers[1], boxes)


def change_of(url: str, row: Sequence[Any]) -> Change:
    """Parse a committed write (revision, action, id, ranges); ranges as bytes or as a list."""
    revision, action, object_id, ranges = row
    place = f"change {revision!s:.40}"
    if not _is_count(revision) or not _is_count(object_id) or action not in ACTIONS:
        raise damaged(url, f"{place}: its number, action or object is none")
    pairs = _int64s(ranges)
    if pairs is None or len(pairs) % 2 or (np.diff(pairs) < 0).any() or (pairs < 0).any():
        raise damaged(url, f"{place}: its ranges are no ascending pairs of keys")
    return Change(revision, action, object_id, pairs.reshape(-1, 2))


def surfaces_of(url: str, rows: Iterable[Sequence[Any]]) -> dict[str, bytes]:
    """Parse packed surfaces (digest, geometry); `mesh.surface_packing` validates the bytes."""
    found = {}
    for digest, geometry in rows:
        if not (isinstance(digest, str) and isinstance(geometry, bytes)):
            raise damaged(url, f"surface {digest!s:.40}: its digest is no text, or it is no bytes")
        found[digest] = geometry
    return found


def pair_of(url: str, row: Sequence[Any]) -> PairRow:
    """Parse a pair: a, b, kind, at_least, at_most, its place, status, revision, ..., shapes."""
    a, b, kind, at_least, at_most, *place, status, revision, setting, because, shapes = row
    try:
        # one sum: a NaN or an infinity among the numbers makes it infinite or NaN
        is_sound = math.isfinite(at_least + (at_most or 0.0) + sum(place))
        kind = Kind(kind)
    except (TypeError, ValueError):
        is_sound = False
    if not (
        is_sound
        and type(a) is type(b) is type(revision) is int
        and 0 <= a < b < KEY_END
        and 0 <= revision < KEY_END
        and status in STATUSES
        and isinstance(setting, str)
        and (because is None or isinstance(because, str))
        and (shapes is None or isinstance(shapes, str))
    ):
        raise damaged(url, f"pair {a!s:.40}, {b!s:.40}: it holds what no search for clashes writes")
    return PairRow(
        a, b, kind, at_least, at_most, tuple(place), status, revision, setting, because, shapes
    )


def rule_of(url: str, row: Sequence[Any]) -> Rule:
    """Parse a rule: one, other, says, kinds, length, because."""
    one, other, says, kinds, length, because = row
    try:
        named = tuple(Kind(kind) for kind in kinds.split(",") if kind)
        is_sound = says != "apart" if length is None else 0.0 < length < math.inf
    except (AttributeError, TypeError, ValueError):
        is_sound = False
    if not (
        is_sound
        and says in SAYS
        and bool(named) == (says == "meant")
        and all(isinstance(one, str) for one in row[:2])
        and isinstance(because, str)
    ):
        raise damaged(url, f"rule {one!s:.40}, {other!s:.40}: it holds what no rule says")
    return Rule(one, other, says, named, length, because)


def digests_of(url: str, rows: Iterable[Sequence[Any]]) -> set[str]:
    """Parse the digests (digest,) of surfaces."""
    found = {row[0] for row in rows}
    if not all(isinstance(digest, str) for digest in found):
        raise damaged(url, "a surface whose digest is no text")
    return found


def histogram_of(url: str, bounds: object, n_rows: object) -> Histogram:
    """Parse a stored histogram; bounds as bytes or as a list."""
    keys = _int64s(bounds)
    if keys is None or len(keys) < 2 or (np.diff(keys) < 0).any() or not _is_count(n_rows):
        raise damaged(
            url,
            "stored statistics are no ascending keys; 'hapticdb info --calibrate' renews them",
        )
    return Histogram(keys, cast("int", n_rows), "kept")


def figures_of(url: str, text: object) -> Mapping[str, float]:
    """Parse the stored figures of a cost model: finite numbers by name."""
    figures = _json_of(text)
    if figures is None or not all(_is_finite(value) for value in figures.values()):
        cause = "stored costs are no numbers; 'hapticdb info --calibrate' renews them"
        raise damaged(url, cause)
    return cast("Mapping[str, float]", figures)


def number_of(url: str, value: object, what: str) -> int:
    """Parse a count, such as a revision."""
    if not _is_count(value):
        raise damaged(url, f"{what} is no count")
    return cast("int", value)


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < KEY_END


def _is_finite(value: object) -> bool:
    return type(value) in {int, float} and abs(cast("float", value)) <= sys.float_info.max


def _doubles(stored: object, count: int) -> Floats | None:
    """Finite float64 of this count, from bytes or a list of numbers; None for anything else."""
    if isinstance(stored, bytes) and len(stored) == 8 * count:
        found = np.frombuffer(stored, dtype="<f8")
    elif isinstance(stored, list) and all(_is_finite(value) for value in stored):
        found = np.array(stored, dtype=np.float64)
        found.flags.writeable = False  # of a shared object
    else:
        return None
    return found if len(found) == count and np.isfinite(found).all() else None


def _int64s(stored: object) -> Keys | None:
    """Int64s from bytes or a list of numbers; None for anything else."""
    if isinstance(stored, bytes) and len(stored) % 8 == 0:
        return np.frombuffer(stored, dtype="<i8").astype(np.int64)
    if isinstance(stored, list) and all(type(value) is int for value in stored):
        return np.array(stored, dtype=np.int64)
    return None


def _json_of(stored: object) -> dict[str, Any] | None:
    """JSON object of a text; None for anything else."""
    if not isinstance(stored, str):
        return None
    try:
        found = json.loads(stored)
    # deep nesting exhausts the parser's stack: RecursionError
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _crc_of(stored: object) -> int | None:
    try:
        return int(stored, 16) if isinstance(stored, str) and len(stored) == 16 else None
    except ValueError:
        return None
