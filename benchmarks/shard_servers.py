"""A generated scene on a coordinator and three shards, and frames over it.

For `sharded_frames.py`: wavy sheets of bricks, whole in one table of the coordinator and in thirds
on the shards, with the coordinator's foreign tables over them.
"""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psycopg
from numpy.typing import NDArray
from psycopg import conninfo

import hapticdb
from hapticdb import Grid
from hapticdb.store.base import BRICK_BYTES
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.private_server import Binaries
from hapticdb.store.postgres.shards import foreign
from places import serving

Keys = NDArray[np.int64]
SHARDS = 3
SETTINGS = {"shared_buffers": "512MB", "fsync": "off", "max_wal_size": "4GB"}
NAME = "plant"
SHEETS = 3
"""Surfaces of the scene, each of `side` x `side` bricks."""
POINTS = 300
RADIUS = 6.0
"""Radius of the ball, bricks."""
PREFETCHED = 256
"""Cells of a prefetch: those nearest to the tool."""
TRIES = 200
"""Most balls drawn for a frame that touches as many shards as wanted."""
_ROW = np.dtype(
    [("n", ">i2"), ("l0", ">i4"), ("z", ">i8"), ("l1", ">i4"), ("id", ">i8"), ("l2", ">i4"),
     ("bits", f"V{BRICK_BYTES}"), ("l3", ">i4"), ("version", ">i8")]
)  # fmt: skip


# --- the scene ----------------------------------------------------------------------------------


class Scene(NamedTuple):
    """Rows (R,) in the order of the index, and the first cell of each shard."""

    keys: Keys
    ids: Keys
    borders: Keys
    side: int


def interleaved(ijk: Keys) -> Keys:
    """Z-order keys of bricks (N, 3)."""
    keys = np.zeros(len(ijk), np.int64)
    for bit in range(14):
        for axis in range(3):
            keys |= ((ijk[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys


def made_scene(side: int) -> Scene:
    """Wavy sheets, one over the other, cut into 16 x 16 objects each."""
    i, j = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(side)], indexing="ij"))
    keys, ids = [], []
    for sheet in range(SHEETS):
        wave = np.sin(9 * i / side + sheet) * np.cos(7 * j / side - sheet)
        k = (side / 2 + 0.12 * side * wave + 0.06 * side * (sheet - 1)).astype(np.int64)
        keys.append(interleaved(np.stack([i, j, k], axis=1)))
        ids.append(1 + 256 * sheet + 16 * (16 * i // side) + 16 * j // side)
    z, number = np.concatenate(keys), np.concatenate(ids)
    order = np.lexsort((number, z))
    z, number = z[order], number[order]
    firsts = [0, *(int(z[len(z) * n // SHARDS] >> 6) for n in range(1, SHARDS))]
    return Scene(z, number, np.array(firsts), side)


class Frame(NamedTuple):
    """What one frame asks for: bricks (U,), their cells, ranges by count, cells of a prefetch."""

    keys: Keys
    cells: Keys
    ranges: dict[int, tuple[Keys, Keys]]
    near: Keys


def ranges_over(keys: Keys, count: int) -> tuple[Keys, Keys]:
    """Ranges (lows, highs) that cover the keys; the widest gaps are left out."""
    cuts = np.sort(np.argsort(np.diff(keys))[::-1][: count - 1]) + 1
    return keys[np.concatenate([[0], cuts])], keys[np.concatenate([cuts - 1, [len(keys) - 1]])]


def frame_at(scene: Scene, ball: NDArray[np.float64], middle: Keys) -> Frame:
    voxels = np.clip(np.floor(middle + 0.5 + ball), 0, scene.side - 1).astype(np.int64)
    keys = np.unique(interleaved(voxels))
    reach = np.stack(np.meshgrid(*3 * [np.arange(-4, 5)], indexing="ij"), axis=-1).reshape(-1, 3)
    near = (middle >> 2) + reach[np.argsort((reach**2).sum(axis=1), kind="stable")]
    near = near[((near >= 0) & (near < scene.side >> 2)).all(axis=1)][:PREFETCHED]
    return Frame(
        keys,
        np.unique(keys >> 6),
        {count: ranges_over(keys, count) for count in (20, 60)},
        np.sort(interleaved(near)),
    )


def drawn_frames(scene: Scene, count: int, n_owners: int) -> list[Frame]:
    """Frames at random rows, of those that touch that many shards."""
    rng = np.random.default_rng(n_owners)
    ball = hapticdb.PointShell.sphere(RADIUS, POINTS).points
    near_border = np.searchsorted(scene.keys, scene.borders[1:] << 6)
    found: list[Frame] = []
    for _ in range(TRIES * count):
        row = int(rng.integers(len(scene.keys)))
        if n_owners > 1:  # else they are one in a thousand
            row = int(rng.choice(near_border) + rng.integers(-200, 200))
        key = int(scene.keys[row])
        middle = np.array(
            [sum(((key >> (3 * bit + axis)) & 1) << bit for bit in range(14)) for axis in range(3)]
        )
        frame = frame_at(scene, ball, middle)
        owners = np.searchsorted(scene.borders, frame.cells, side="right")
        if len(np.unique(owners)) == n_owners:
            found.append(frame)
            if len(found) == count:
                return found
    raise RuntimeError(f"{len(found)} frames of {n_owners} shards: choose a larger scene")


# --- servers ------------------------------------------------------------------------------------


def filled(url: str, table: str, rows: Scene, where: NDArray[np.bool_], *, versions: bool) -> None:
    """Copy rows into a table."""
    packed = np.empty(int(where.sum()), _ROW)
    packed["n"] = 4
    packed["l0"] = packed["l1"] = packed["l3"] = 8
    packed["l2"] = BRICK_BYTES
    packed["z"], packed["id"] = rows.keys[where], rows.ids[where]
    packed["version"] = version_of(rows.ids[where])
    packed["bits"] = np.frombuffer(bytes(range(BRICK_BYTES)), f"V{BRICK_BYTES}")[0]
    names = "z_val, id, occupancy, version" if versions else "z_val, id, occupancy"
    data = packed.tobytes()
    if not versions:  # the version is what each row ends with
        packed["n"] = 3
        data = packed.view(np.uint8).reshape(len(packed), -1)[:, :-12].tobytes()
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute(f"SET search_path = {NAME}")
        with connection.cursor().copy(f"COPY {table} ({names}) FROM STDIN (FORMAT binary)") as copy:
            copy.write(wire.COPY_HEADER + data + wire.COPY_TRAILER)
        connection.execute(f"VACUUM ANALYZE {table}")


def version_of(ids: Keys) -> Keys:
    """Version of each object's rows: any number that differs from object to object."""
    return (ids * 0x1E3779B97F4A7C15 & (2**62 - 1)).astype(np.int64)


def make_shard(url: str, rows: Scene, number: int) -> None:
    with psycopg.connect(url, autocommit=True) as connection:
        for statement in (
            f"CREATE SCHEMA {NAME}",
            f"SET search_path = {NAME}",
            "CREATE TABLE mark (token uuid, writes bigint, swept bigint, moved bigint)",
            (
                "CREATE TABLE brick (z_val bigint NOT NULL, id bigint NOT NULL,"
                " occupancy bytea NOT NULL, version bigint NOT NULL)"
            ),
            "CREATE TABLE band (z_val bigint, id bigint, distances bytea, version bigint)",
            (
                "ALTER TABLE brick ALTER occupancy SET STORAGE PLAIN,"
                " ALTER z_val SET STATISTICS 10000, ALTER id SET STATISTICS 0,"
                " ALTER occupancy SET STATISTICS 0"
            ),
            "CREATE UNIQUE INDEX brick_key ON brick (z_val, id, version)",
            *foreign.SHARD_VIEWS["brick"],
            *foreign.SHARD_VIEWS["band"],
        ):
            connection.execute(statement)
    owner = np.searchsorted(rows.borders, rows.keys >> 6, side="right") - 1
    filled(url, "brick", rows, owner == number, versions=True)


def make_coordinator(url: str, shards: Sequence[str], rows: Scene) -> None:
    """All rows in one table, the foreign tables, and a parent partitioned by keys beside."""
    with_name = with_environment(url, NAME)
    bits = max(int(rows.side * 8 - 1).bit_length(), 5)
    hapticdb.create(with_name, Grid(0.01, (0, 0, 0), bits), distances=False).close()
    filled(url, "brick", rows, np.ones(len(rows.keys), np.bool_), versions=False)
    connection = schema_of.connected(with_name)
    connection.command(
        "CREATE TABLE distribution (id integer, token uuid, epoch bigint);"
        "INSERT INTO distribution VALUES (1, gen_random_uuid(), 0);"
        "CREATE TABLE shard (number integer, host text, first_key bigint, writes bigint);"
        "CREATE TABLE live (id bigint PRIMARY KEY, version bigint)"
    )
    ids = np.unique(rows.ids)
    connection.execute(
        "INSERT INTO live SELECT * FROM unnest(%s::bigint[], %s::bigint[])",
        (ids.tolist(), version_of(ids).tolist()),
    )
    places = {}
    for number, there in enumerate(shards, 1):
        first = int(rows.borders[number - 1]) << 15
        connection.execute("INSERT INTO shard VALUES (%s, '', %s, 0)", (number, first))
        words = {key: str(value) for key, value in conninfo.conninfo_to_dict(there).items()}
        places[number] = foreign.Place(words, {"user": words.pop("user")})
    connection.write(lambda: foreign.align(connection, "brick", places))
    servers = connection.rows("SELECT srvname FROM pg_foreign_server ORDER BY 1")
    connection.command(
        "CREATE TABLE by_key (z_val bigint, id bigint, version bigint, occupancy bytea)"
        " PARTITION BY RANGE (z_val)"
    )
    for number, (server,) in enumerate(servers, 1):
        last = f"{rows.borders[number] << 6}" if number < SHARDS else "MAXVALUE"
        connection.command(
            f"CREATE FOREIGN TABLE by_key_{number} PARTITION OF by_key FOR VALUES"
            f" FROM ({rows.borders[number - 1] << 6}) TO ({last}) SERVER {server}"
            f" OPTIONS (schema_name '{NAME}', table_name 'brick_of_shard')"
        )
    connection.command("VACUUM ANALYZE live")
    connection.close()


@contextlib.contextmanager
def cluster(binaries: Binaries, folder: Path, scene: Scene) -> Iterator[list[str]]:
    """URLs of a coordinator and its shards, filled."""
    with contextlib.ExitStack() as running:
        urls = []
        for n in range(SHARDS + 1):
            where = folder / f"pg{binaries.major}-{n}"
            urls.append(running.enter_context(serving(where, binaries, SETTINGS)).conninfo())
        for n, url in enumerate(urls[1:]):
            make_shard(url, scene, n)
        make_coordinator(urls[0], urls[1:], scene)
        yield urls
