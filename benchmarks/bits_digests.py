"""Digests that `same_bits` compares: of an environment's rows, touches, sessions and sweeps.

As in `same_bits`, only public names of hapticdb and its command line are used.
"""

import contextlib
import hashlib
import json
import sqlite3
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

import hapticdb
from bits_inputs import Place, Tool, command

Strategy = Literal["statement", "array", "points", "maxgap", "cbgroup", "auto"]
STRATEGIES: tuple[Strategy, ...] = ("statement", "array", "points", "maxgap", "cbgroup", "auto")
MEASURED = ("cbgroup", "auto")
"""Strategies whose statements depend on measured costs, and so differ between runs."""
SESSION = "--rate 512 --speed 0.1 --simulate --no-baseline --seconds 2 --record"


class Digest:
    """SHA-256 of arrays with their types and shapes, which keep neighbouring arrays apart."""

    def __init__(self) -> None:
        self._sha = hashlib.sha256()

    def feed(self, *values: ArrayLike) -> None:
        """Add arrays, numbers or text."""
        for value in values:
            array = np.ascontiguousarray(value)
            self._sha.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())

    def entry(self, n: int, of: str, differing: int = 0) -> dict[str, Any]:
        """Entry of the JSON file: digest, number `n` of things `of` a kind, number differing."""
        return {"sha256": self._sha.hexdigest(), "n": n, "of": of, "differing": differing}


class Results(dict[str, dict[str, Any]]):
    """Entries by name; each is printed, with the seconds it took, and written when it is added.

    file : JSON to write; versions : of the code, as written there.
    """

    def __init__(self, file: Path, versions: dict[str, str]) -> None:
        super().__init__()
        self._file, self._versions, self._since = file, versions, time.perf_counter()

    def __setitem__(self, name: str, entry: dict[str, Any]) -> None:
        super().__setitem__(name, entry)
        record = {"versions": self._versions, "entries": self}
        self._file.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        now = time.perf_counter()
        wrong = f", {entry['differing']} DIFFER" if entry["differing"] else ""
        print(f"{now - self._since:6.1f} s  {name}: {entry['n']} {entry['of']}{wrong}", flush=True)
        self._since = now


def stored(place: Place, env: hapticdb.Environment, results: Results) -> None:
    """Digest objects, voxels, the histogram of keys, and all rows (on a server: of a copy)."""
    digest, n_voxels = Digest(), 0
    for obj in env.objects():
        described = json.dumps(dict(obj.attributes), sort_keys=True, default=str)
        digest.feed(obj.id, obj.name, obj.digest, obj.transform, obj.bounds, described)
        digest.feed(obj.voxels, obj.revision, voxels := env.voxels(obj.id))
        n_voxels += len(voxels)
    results[f"{place.name}/objects"] = digest.entry(n_voxels, "voxels")
    quantiles = env.quantiles()
    (digest := Digest()).feed(quantiles.bounds)
    results[f"{place.name}/quantiles"] = digest.entry(int(quantiles.n_rows), "rows")
    digest, n_rows = Digest(), 0
    with tempfile.TemporaryDirectory() as folder:
        file = place.url
        if "://" in file:
            hapticdb.copy_environment(file, file := str(Path(folder, "copy.db")))
        with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as db:
            found = db.execute(f"SELECT * FROM {place.layout} ORDER BY z_val, id")
            while rows := found.fetchmany(100_000):
                digest.feed(repr(rows))
                n_rows += len(rows)
    results[f"{place.name}/rows"] = digest.entry(n_rows, "rows")


def touched(place: Place, env: hapticdb.Environment, tool: Tool, results: Results) -> None:
    """Digest touches at all poses, by each strategy and all at once."""
    for strategy in STRATEGIES:
        felt, asked, n_hit = Digest(), Digest(), 0
        for pose in tool.poses:
            touch = env.touch(tool.shell, pose, strategy)
            felt.feed(touch.force, touch.torque, touch.hits, touch.depths, touch.contacts)
            felt.feed(touch.pairs, np.array([obj.id for obj in touch.objects], dtype=np.int64))
            asked.feed(touch.query.statements, touch.query.ranges, touch.query.rows)
            n_hit += len(touch.hits) > 0
        results[f"{place.name}/{strategy}"] = felt.entry(n_hit, f"of {len(tool.poses)} poses hit")
        if strategy not in MEASURED:
            results[f"{place.name}/{strategy} asks"] = asked.entry(len(tool.poses), "poses")
    many = env.touch(tool.shell, poses=tool.poses, objects=True)
    (digest := Digest()).feed(many.forces, many.torques, many.hits, many.n_contacts, many.deepest)
    digest.feed(many.ids, many.offsets)
    n_hit = int(np.count_nonzero(many.hits))
    results[f"{place.name}/at once"] = digest.entry(n_hit, f"of {len(many)} poses hit")


def recorded(place: Place, tool: Tool, file: Path) -> Path:
    """Record a session anew: a hand on the path, which the force pushes back."""
    file.unlink(missing_ok=True)
    words = ["--tool", tool.mesh, "--device", tool.hand, *SESSION.split(), file]
    command("feel", place.url, "--law", "plane", *words)
    return file


def replayed(place: Place, env: hapticdb.Environment, file: Path, results: Results) -> None:
    """Replay a recording in this process and by the verb."""
    recording = hapticdb.Recording(file)
    of, n_frames = f"of {len(recording)} recorded frames compared", len(recording)
    found = hapticdb.replay(recording, env)
    (digest := Digest()).feed(n_frames)
    results[f"{place.name}/replay"] = digest.entry(found.n_frames, of, found.n_differing)
    told = command("replay", file, place.url)
    (digest := Digest()).feed(told["frames"])
    results[f"{place.name}/replay by the verb"] = digest.entry(
        told["frames"], of, told["differing"]
    )


def swept(place: Place, tool: Tool, results: Results) -> None:
    """Digest the result of ``sweep`` on the spanner's path, without time and names of files."""
    verdict = command("sweep", place.url, "--tool", tool.mesh, "--path", tool.path)
    for name in ("elapsed", "moved", "path"):
        del verdict[name]
    (digest := Digest()).feed(json.dumps(verdict, sort_keys=True))
    results[f"{place.name}/sweep"] = digest.entry(
        len(verdict["hits"]), f"objects hit: {verdict['line']}"
    )
