"""Frames over three shards: owners asked by the client, or the coordinator asked over postgres_fdw.

    python benchmarks/sharded_frames.py                 # 3.1 million rows, PostgreSQL 15 and 18
    python benchmarks/sharded_frames.py --side 128 --frames 5       # whether all of it runs

Four private servers of each version: a coordinator, which also has all rows in one table, and three
shards with a third of the rows each. A frame has 300 points on a ball; it asks for their bricks,
for 20 or 60 ranges that cover them, or for the 256 cells around. All ways take turns, frame by
frame; all of them must give the same rows. Times are medians in microseconds; read their ratios.
"""

import argparse
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from psycopg import pq

from awake import awake
from hapticdb.bench import records
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.link import SETTINGS as LINK_SETTINGS
from hapticdb.store.postgres.private_server import Binaries, find_binaries
from shard_servers import (
    NAME,
    POINTS,
    SETTINGS,
    SHARDS,
    Frame,
    Keys,
    Scene,
    cluster,
    drawn_frames,
    made_scene,
)

FRAMES = 60
WARMED = 12
"""Frames of each line before the measurement."""
EVERYTHING_S = 0.4
"""A way that takes longer for a frame is measured by that frame alone."""
PACKED = "array_agg(z_val), array_agg(id), string_agg(occupancy, '')"


# --- ways to ask --------------------------------------------------------------------------------


class Asker:
    """A connection that sends prepared statements, and takes their results when asked to."""

    def __init__(self, url: str, plans: str) -> None:
        self._pgconn = pq.PGconn.connect(url.encode())
        assert self._pgconn.status == pq.ConnStatus.OK
        for name, value in {**LINK_SETTINGS, "plan_cache_mode": plans}.items():
            self._pgconn.exec_(f"SET {name} = '{value}'".encode())
        self._pgconn.exec_(f"SET statement_timeout = 0; SET search_path = {NAME}".encode())
        self._names: dict[str, bytes] = {}

    def send(self, text: str, parameters: Sequence[wire.Parameter]) -> None:
        name = self._names.get(text)
        if name is None:
            name = self._names[text] = f"s{len(self._names)}".encode()
            made = self._pgconn.prepare(name, text.encode(), [p.oid for p in parameters])
            assert made.status == pq.ExecStatus.COMMAND_OK, made.error_message
        values = [p.value for p in parameters]
        self._pgconn.send_query_prepared(name, values, [1] * len(values), 1)

    def take(self) -> tuple[Keys, Keys]:
        """Keys and ids; waits for them."""
        result = self._pgconn.get_result()
        assert result is not None
        assert result.status == pq.ExecStatus.TUPLES_OK, result.error_message
        found = wire.read_int8s(result.get_value(0, 0)), wire.read_int8s(result.get_value(0, 1))
        while self._pgconn.get_result() is not None:
            pass
        return found

    def close(self) -> None:
        self._pgconn.finish()


Found = tuple[Keys, Keys]
Way = Callable[[Frame], Found]
ANY = f"SELECT {PACKED} FROM {{table}} WHERE z_val = ANY ($1)"
JOIN = (
    f"SELECT {PACKED} FROM unnest($1, $2) AS range(low, high) JOIN {{table}}"
    " ON z_val BETWEEN range.low AND range.high"
)
CELLS = f"SELECT {PACKED} FROM {{table}} WHERE cell = ANY ($1)"
BOTH = f"SELECT {PACKED} FROM {{table}} WHERE cell = ANY ($2) AND z_val = ANY ($1)"
# keys are looked up at the coordinator: a shard plans `z_val = ANY` for milliseconds
LATE = (
    f"WITH held AS MATERIALIZED (SELECT * FROM {{table}} WHERE cell = ANY ($2))"
    f" SELECT {PACKED} FROM unnest($1) AS asked(key) JOIN held ON z_val = asked.key"
)
LATE_RANGES = (
    f"WITH held AS MATERIALIZED (SELECT * FROM {{table}} WHERE cell = ANY ($3))"
    f" SELECT {PACKED} FROM unnest($1, $2) AS range(low, high) JOIN held"
    " ON z_val BETWEEN range.low AND range.high"
)
KNOWN = "SELECT array[revision], array[epoch] FROM environment, distribution"


def or_of(count: int) -> str:
    words = " OR ".join(f"z_val BETWEEN ${2 * n + 1} AND ${2 * n + 2}" for n in range(count))
    return f"SELECT {PACKED} FROM {{table}} WHERE {words}"


class Ways:
    """Connections of one version's servers, and the ways to answer a frame over them."""

    def __init__(self, urls: Sequence[str], scene: Scene, opened: contextlib.ExitStack) -> None:
        def asker(url: str, plans: str = "force_generic_plan") -> Asker:
            made = Asker(url, plans)
            opened.callback(made.close)
            return made

        self._borders = scene.borders
        self._one = asker(urls[0])
        self._owners = [asker(url) for url in urls[1:]]
        self._fdw = asker(urls[0], "force_custom_plan")

    def one(self, text: str, *values: Keys) -> Found:
        self._one.send(text.format(table="brick"), [wire.int8s(v) for v in values])
        return self._one.take()

    def fdw(self, text: str, table: str, *values: Keys) -> Found:
        self._fdw.send(text.format(table=table), [wire.int8s(v) for v in values])
        return self._fdw.take()

    def fdw_or(self, lows: Keys, highs: Keys) -> Found:
        # a power of two of ranges, the last one repeated, so that frames share statements
        more = (1 << (len(lows) - 1).bit_length()) - len(lows)
        lows, highs = np.append(lows, more * [lows[-1]]), np.append(highs, more * [highs[-1]])
        ends = [wire.int8(int(v)) for pair in zip(lows, highs, strict=True) for v in pair]
        self._fdw.send(or_of(len(lows)).format(table="by_key"), ends)
        return self._fdw.take()

    def owners(self, text: str, *values: Keys, at_once: bool) -> Found:
        """Ask the owner of each key or range; at once also the coordinator for its revision."""
        asked: list[tuple[Asker, list[wire.Parameter]]] = []
        borders = np.append(self._borders << 6, np.int64(2**62))
        for n, owner in enumerate(self._owners):
            first = np.searchsorted(values[-1], borders[n])  # of the ends of ranges
            last = np.searchsorted(values[0], borders[n + 1])
            if first < last:  # a range over a border goes to both owners
                asked.append((owner, [wire.int8s(v[first:last]) for v in values]))
        statement = text.format(table="brick")
        if not at_once:
            found = []
            for owner, parameters in asked:
                owner.send(statement, parameters)
                found.append(owner.take())
            self._one.send(KNOWN, [])
            self._one.take()
            return joined(found)
        for owner, parameters in asked:
            owner.send(statement, parameters)
        self._one.send(KNOWN, [])
        found = [owner.take() for owner, _ in asked]
        self._one.take()
        return joined(found)

    def of(self, task: str) -> dict[str, Way]:
        """Ways to answer a task: ``points``, ``20 ranges``, ``60 ranges`` or ``256 cells``."""
        if task == "points":
            return {
                "one server, = ANY": lambda f: self.one(ANY, f.keys),
                "owners in turn": lambda f: self.owners(ANY, f.keys, at_once=False),
                "owners at once": lambda f: self.owners(ANY, f.keys, at_once=True),
                "fdw, z_val = ANY": lambda f: self.fdw(ANY, "by_key", f.keys),
                "fdw, cell and z_val = ANY": lambda f: self.fdw(BOTH, "brick_all", f.keys, f.cells),
                "fdw, cell = ANY, keys late": lambda f: self.fdw(
                    LATE, "brick_all", f.keys, f.cells
                ),
                "fdw, the same of live rows": lambda f: self.fdw(
                    LATE, "brick_live", f.keys, f.cells
                ),
            }

        def ends(frame: Frame) -> tuple[Keys, Keys]:
            if task == "256 cells":
                return runs_of(frame.near)
            return frame.ranges[int(task.split(maxsplit=1)[0])]

        def cells(frame: Frame) -> Keys:
            if task == "256 cells":
                return frame.near
            return cells_of(*ends(frame))

        found: dict[str, Way] = {
            "one server, unnest join": lambda f: self.one(JOIN, *ends(f)),
            "owners in turn": lambda f: self.owners(JOIN, *ends(f), at_once=False),
            "owners at once": lambda f: self.owners(JOIN, *ends(f), at_once=True),
            "fdw, OR of BETWEENs": lambda f: self.fdw_or(*ends(f)),
        }
        if task == "20 ranges":  # the shards send all of their rows: seconds
            found["fdw, unnest join"] = lambda f: self.fdw(JOIN, "by_key", *ends(f))
        for name, table in (("all", "brick_all"), ("live", "brick_live")):
            if task == "256 cells":
                found[f"fdw, cell = ANY, {name} rows"] = lambda f, table=table: self.fdw(  # type: ignore[misc]
                    CELLS, table, cells(f)
                )
            else:
                found[f"fdw, cell = ANY, ranges late, {name} rows"] = lambda f, table=table: (  # type: ignore[misc]
                    self.fdw(LATE_RANGES, table, *ends(f), cells(f))
                )
        return found


def joined(found: list[Found]) -> Found:
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def cells_of(lows: Keys, highs: Keys) -> Keys:
    """Cells that ranges of bricks reach, ascending."""
    each = [np.arange(low >> 6, (high >> 6) + 1) for low, high in zip(lows, highs, strict=True)]
    return np.unique(np.concatenate(each))


def runs_of(cells: Keys) -> tuple[Keys, Keys]:
    """Ranges of bricks that cover cells; neighbours in one."""
    starts = np.flatnonzero(np.diff(cells, prepend=-2) != 1)
    lasts = np.append(starts[1:] - 1, len(cells) - 1)
    return cells[starts] << 6, (cells[lasts] << 6) + 63


# --- measuring ----------------------------------------------------------------------------------

TASKS = ("points", "20 ranges", "60 ranges", "256 cells")


def measured(ways: dict[str, Way], frames: list[Frame]) -> tuple[dict[str, Any], int]:
    """Microseconds of each way, frame by frame in turns; the median number of rows."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    slow: set[str] = set()
    sizes = []
    for n, frame in enumerate([*frames[:WARMED], *frames]):
        wanted: list[tuple[int, int]] | None = None
        order = list(ways)
        for name in order[n % len(order) :] + order[: n % len(order)]:
            if name in slow:
                continue
            started = time.perf_counter()
            keys, ids = ways[name](frame)
            seconds = time.perf_counter() - started
            rows = sorted(zip(keys.tolist(), ids.tolist(), strict=True))
            wanted = rows if wanted is None else wanted
            assert rows == wanted, f"{name}: {len(rows)} rows instead of {len(wanted)}"
            if seconds > EVERYTHING_S:
                slow.add(name)
                times[name] = [1e6 * seconds]
            elif n >= min(WARMED, len(frames)):
                times[name].append(1e6 * seconds)
        sizes.append(len(wanted or ()))
    found = {}
    base = float(np.median(next(iter(times.values()))))
    for name, each in times.items():
        p50, p95 = np.percentile(each, [50, 95]).tolist()
        found[name] = {"us": p50, "p95_us": p95, "of_one_server": p50 / base, "n": len(each)}
    return found, int(np.median(sizes))


def on_version(binaries: Binaries, folder: Path, scene: Scene, count: int) -> list[dict[str, Any]]:
    lines = []
    with cluster(binaries, folder, scene) as urls, contextlib.ExitStack() as opened:
        ways = Ways(urls, scene, opened)
        for n_owners in (1, 2):
            frames = drawn_frames(scene, count, n_owners)
            for task in TASKS:
                load = os.getloadavg()[0]
                times, rows = measured(ways.of(task), frames)
                line = {
                    "postgres": binaries.major,
                    "owners_of_frame": n_owners,
                    "task": task,
                    "rows": rows,
                    "distinct_keys": float(np.median([len(frame.keys) for frame in frames])),
                    "cells": float(np.median([len(frame.cells) for frame in frames])),
                    "load_before": load,
                    "load_after": os.getloadavg()[0],
                    "ways": times,
                }
                lines.append(line)
                print(json.dumps(line), flush=True)
    return lines


def main() -> None:
    """Measure all lines and write them to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--side", type=int, default=1024, help="of the scene, bricks")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--major", type=int, help="of PostgreSQL; all found unless given")
    parser.add_argument("--busy", action="store_true", help="note that other work runs, too")
    parser.add_argument("--out", type=Path, default=Path("results/sharded_frames.json"))
    given = parser.parse_args()
    scene = made_scene(given.side)
    lines = []
    with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-shards-") as folder:
        for binaries in find_binaries():
            if given.major not in {None, binaries.major}:
                continue
            lines += on_version(binaries, Path(folder), scene, given.frames)
    found = {
        **records.conditions(),
        "rows": len(scene.keys),
        "shards": SHARDS,
        "points": POINTS,
        "frames": given.frames,
        "settings": SETTINGS,
        "is_busy": given.busy,
        "servers": "private, Unix sockets, on the machine of the client",
        "lines": lines,
    }
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
