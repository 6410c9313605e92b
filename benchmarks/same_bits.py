"""Prove that two commits compute the same: every wrench, row, session and sweep, bit for bit.

    HAPTICDB_TEST_DATA=... python benchmarks/same_bits.py --before /tmp/before/src [--quick]

Each tree runs in a process of its own. It imports the vintage car (without data the sample) on
SQLite in both layouts and on every PostgreSQL found; its digests are of the stored rows, of
touches by each strategy and of all poses at once, of the statements of strategies unless they
depend on measured costs, of ``sweep``, and of replays of sessions that the first tree recorded.
Only public names and the command line are used.
"""

import argparse
import contextlib
import hashlib
import json
import os
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

import hapticdb
import records
from hapticdb.sample import write_sample
from places import find_binaries, serving
from slide_paths import write_along

Layout = Literal["brick", "voxel"]
Strategy = Literal["statement", "array", "points", "maxgap", "cbgroup", "auto"]
STRATEGIES: tuple[Strategy, ...] = ("statement", "array", "points", "maxgap", "cbgroup", "auto")
MEASURED = ("cbgroup", "auto")
"""Strategies whose statements depend on measured costs, and so differ between runs."""
HAND = slice(200, 700)
"""Poses of the path that a session's hand follows; at the first the tool touches nothing."""
SESSION = "--law plane --rate 512 --speed 0.1 --simulate --no-baseline --seconds 2 --record"
LONGEST_S = 3600.0
"""Seconds after which a tree counts as hung."""


class Digests(dict[str, tuple[str, str]]):
    """SHA-256 and what was digested, by name; types and shapes keep neighbouring arrays apart."""

    def add(self, name: str, of: str, *values: ArrayLike) -> None:
        """Digest arrays, numbers or text."""
        sha = hashlib.sha256()
        for value in values:
            array = np.ascontiguousarray(value)
            sha.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
        self[name] = sha.hexdigest(), of
        print(name, of, file=sys.stderr, flush=True)


def command(*words: object) -> dict[str, Any]:
    """Run ``hapticdb`` and return its JSON; exit codes 1 and 3 are verdicts, not failures."""
    line = [sys.executable, "-m", "hapticdb", *map(str, words), "--json"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode not in {0, 1, 3} or not done.stdout:
        raise SystemExit(f"{' '.join(line)} ends with {done.returncode}: {done.stderr}")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def places(folder: Path, *, is_quick: bool) -> Iterator[tuple[str, str, Layout]]:
    """Name, URL and layout of each environment; a server ends with its turn."""
    layouts: tuple[Layout, ...] = ("brick",) if is_quick else ("brick", "voxel")
    for layout in layouts:
        yield f"sqlite-{layout}", str(folder / f"{layout}.db"), layout
    for found in () if is_quick else find_binaries():
        with serving(folder / f"server{found.major}", found, {}) as server:
            yield f"postgresql{found.major}", server.conninfo(), "brick"


def chosen_poses(path: NDArray[np.float64], count: int, voxel: float) -> NDArray[np.float64]:
    """Poses (count, 4, 4) around a path over surfaces, shifted by voxels; half are turned."""
    rng = np.random.default_rng(13)
    poses = rng.choice(path, count)
    poses[:, :3, 3] += rng.normal(size=(count, 3)) * 3.0 * voxel
    poses[::2, :3, :3] = Rotation.random(len(poses[::2]), random_state=13).as_matrix()
    return poses


def stored(digests: Digests, name: str, env: hapticdb.Environment, url: str, table: str) -> None:
    """Objects, voxels, the histogram of keys, and all rows (on a server: of a copy)."""
    for obj in env.objects():
        described = json.dumps(dict(obj.attributes), sort_keys=True, default=str)
        about = obj.id, obj.name, obj.digest, obj.transform, obj.bounds, described, obj.revision
        digests.add(f"{name}/object {obj.id}", f"{obj.voxels} voxels", *about, env.voxels(obj.id))
    digests.add(f"{name}/quantiles", "", env.quantiles().bounds)
    with tempfile.TemporaryDirectory() as folder:
        if "://" in url:
            hapticdb.copy_environment(url, url := str(Path(folder, "copy.db")))
        with contextlib.closing(sqlite3.connect(f"file:{url}?mode=ro", uri=True)) as db:
            rows = [repr(row) for row in db.execute(f"SELECT * FROM {table} ORDER BY z_val, id")]
    digests.add(f"{name}/rows", f"{len(rows)} rows", "\n".join(rows))


def touched(
    digests: Digests,
    name: str,
    env: hapticdb.Environment,
    shell: hapticdb.PointShell,
    poses: NDArray[np.float64],
) -> None:
    """Touches at all poses, by each strategy and all at once."""
    for strategy in STRATEGIES:
        all_ = [env.touch(shell, pose, strategy) for pose in poses]
        felt = [(one.force, one.torque, one.hits, one.depths, one.contacts, one.pairs,
                 np.array([obj.id for obj in one.objects], np.int64)) for one in all_]  # fmt: skip
        n_hit = sum(len(one.hits) > 0 for one in all_)
        flat = [value for one in felt for value in one]
        digests.add(f"{name}/{strategy}", f"{n_hit} of {len(poses)} hit", *flat)
        if strategy not in MEASURED:
            asked = [(one.query.statements, one.query.ranges, one.query.rows) for one in all_]
            digests.add(f"{name}/{strategy} queries", "", asked)
    many = env.touch(shell, poses=poses, objects=True)
    values = many.forces, many.torques, many.hits, many.n_contacts, many.deepest
    digests.add(f"{name}/at once", f"{len(many)} poses", *values, many.ids, many.offsets)


def digests_of(folder: Path, first: Path, *, is_quick: bool, count: int) -> Digests:
    """All digests of this tree; first : folder of the tree that records the sessions."""
    digests, folder = Digests(), folder.resolve()
    sample = write_sample(folder / "sample")
    car = records.data("demo_vintage_car/vintage_car.glb") or sample.car
    grid = hapticdb.GridOptions(bits=9 if is_quick else 11, extent=1.6)
    for name, url, layout in places(folder, is_quick=is_quick):
        options = hapticdb.ImportOptions(grid=grid, layout=layout, distances=False)
        (report,) = hapticdb.import_files(url, [car], options)
        if report.error is not None:
            raise report.error
        mesh, path = write_along(folder / name, url, 1000)
        shell, slide = hapticdb.PointShell.from_file(mesh, 300), hapticdb.read_poses(path)
        hand, recording = folder / "hand.csv", first / f"{name}.rec"
        hapticdb.write_poses(hand, slide[HAND])
        with hapticdb.open(url, read_only=True) as env:
            poses = chosen_poses(slide, count, env.grid.voxel_size)
            digests.add(f"{name}/shell", "", shell.points, shell.normals, shell.center, poses)
            stored(digests, name, env, url, layout)
            touched(digests, name, env, shell, poses)
            if folder == first:
                words = "--tool", mesh, "--device", hand, *SESSION.split(), recording
                command("feel", url, *words)
            found = hapticdb.replay(hapticdb.Recording(recording), env)
            digests.add(f"{name}/replay", f"{found.n_frames} frames", found.n_differing)
        told = command("replay", recording, url)
        digests.add(f"{name}/replay by the verb", f"{told['frames']} frames", told["differing"])
        swept = command("sweep", url, "--tool", mesh, "--path", path)
        kept = {key: swept[key] for key in swept.keys() - {"elapsed", "moved", "path"}}
        digests.add(f"{name}/sweep", swept["line"], json.dumps(kept, sort_keys=True))
        if found.n_differing or told["differing"]:
            raise SystemExit(f"{name}: {found.n_differing} frames of the replay differ")
    return digests


def main() -> int:
    """Run both trees and compare, or be one of them."""
    parser = argparse.ArgumentParser(description=records.first_line(__doc__))
    parser.add_argument("--before", type=Path, default=records.ROOT / "src", help="other tree")
    parser.add_argument("--poses", type=int, default=1000, help="poses of a touch")
    parser.add_argument("--quick", action="store_true", help="bricks on SQLite, 9 bits: a minute")
    parser.add_argument("--folders", nargs=2, type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.folders:
        print(json.dumps(digests_of(*given.folders, is_quick=given.quick, count=given.poses)))
        return 0
    sides: list[dict[str, list[str]]] = []
    with tempfile.TemporaryDirectory() as name:
        first = Path(name, "before").resolve()
        for word, tree in (("before", given.before), ("after", records.ROOT / "src")):
            (own := first.with_name(word)).mkdir()
            line = [*sys.orig_argv, "--folders", str(own), str(first)]
            variables = os.environ | {"PYTHONPATH": str(tree.resolve())}
            done = subprocess.run(
                line, env=variables, check=True, stdout=subprocess.PIPE, timeout=LONGEST_S
            )
            sides.append(json.loads(done.stdout))
    before, after = sides
    names = before | after
    wrong = [each for each in names if before.get(each) != after.get(each)]
    for each in wrong:
        print(f"DIFFERENT {each}: {before.get(each)} and {after.get(each)}")
    print(f"{len(names) - len(wrong)} of {len(names)} the same")
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main())
