"""Prove that two commits compute the same: every wrench, row, session and sweep, bit for bit.

Each commit runs this script once, on the same machine, and writes digests into a JSON file:

    export HAPTICDB_TEST_DATA=/data  PYTHONPATH=/tmp/before/src
    python benchmarks/same_bits.py /tmp/bits/before --out before.json
    export PYTHONPATH=src
    python benchmarks/same_bits.py /tmp/bits/after --out after.json --replay /tmp/bits/before-*.rec
    python benchmarks/same_bits.py --compare before.json after.json

The folder's databases are imported unless they are there: a copy of one commit's folder shows
whether the other commit reads it equally. A run records a session for each environment beside the
folder (``before-sqlite-brick.rec``); ``--replay`` replays those of another commit instead. A
session's times are measured, so two recordings differ: only ``--replay`` compares commits.

Each digest is written when it is found. The environments hold the vintage car at 2048 voxels an
axis, on SQLite in both layouts and on every PostgreSQL found. Compared are the stored rows; force,
torque, hits, depths and objects at 1,000 poses, for each strategy and for all poses at once; the
statements of a strategy, unless they depend on measured costs; the verdict of ``sweep``; and, by
replays, all frames of a session whose simulated hand the force pushes back. Only public names and
the command line are used.
"""

import argparse
import contextlib
import json
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import hapticdb
from bits_digests import Digest, Results, recorded, replayed, stored, swept, touched
from bits_inputs import Place, command, import_car, sample_tool


def recordings_of(places: Sequence[Place], given: Sequence[Path]) -> dict[str, Path]:
    """Environment -> recording; the end of a file's name is the environment's name."""
    found: dict[str, Path] = {}
    for file in given:
        names = [place.name for place in places if file.stem.endswith(place.name)]
        if len(names) != 1 or names[0] in found:
            known = ", ".join(place.name for place in places)
            raise SystemExit(f"{file}: give one recording an environment, named -NAME.rec: {known}")
        found[names[0]] = file
    return found


def measure(
    folder: Path, places: list[Place], given: list[Path], n_poses: int, results: Results
) -> None:
    """Compute all entries on these environments."""
    tool = sample_tool(folder, places[0], n_poses)
    (digest := Digest()).feed(tool.shell.points, tool.shell.normals, tool.shell.center, tool.poses)
    results["tool and poses"] = digest.entry(len(tool.poses), "poses")
    recordings = recordings_of(places, given)
    for place in places:
        own = folder.with_name(f"{folder.name}-{place.name}.rec")
        with hapticdb.open(place.url, read_only=True) as env:
            stored(place, env, results)
            touched(place, env, tool, results)
            if not given or place.name in recordings:
                file = recordings.get(place.name) or recorded(place, tool, own)
                replayed(place, env, file, results)
            swept(place, tool, results)
        if place != places[0]:
            found = command("diff", places[0].url, place.url)
            (digest := Digest()).feed(found["objects"], found["voxels"])
            results[f"{place.name}/diff"] = digest.entry(
                found["voxels"], "voxels", int(not found["is_equal"])
            )


def versions() -> dict[str, str]:
    """Versions of the code, Python and numpy: printed, not compared."""
    source = Path(hapticdb.__file__).parent
    asked = ["git", "-C", str(source), "describe", "--always", "--dirty"]
    commit = subprocess.run(asked, capture_output=True, text=True, timeout=60, check=False)
    return {
        "commit": commit.stdout.strip(),
        "source": str(source),
        "Python": platform.python_version(),
        "numpy": np.__version__,
    }


def compare(sides: Sequence[Path]) -> int:
    """Print how two files differ; return 1 if any entry is different, missing, wrong or empty."""
    a, b = (json.loads(path.read_text(encoding="utf-8")) for path in sides)
    for letter, side in zip("AB", (a, b), strict=True):
        print(letter, *(f"{name} {value}" for name, value in side["versions"].items()))
    n_wrong = 0
    for name in a["entries"] | b["entries"]:
        ours, theirs = a["entries"].get(name), b["entries"].get(name)
        one = ours or theirs
        if ours is None or theirs is None:
            verdict = f"ONLY IN {'A' if theirs is None else 'B'}"
        elif ours != theirs:
            verdict = "DIFFERENT"
        elif ours["differing"]:
            verdict = "WRONG IN BOTH"
        else:
            verdict = "same" if ours["n"] else "NOTHING COMPARED"
        n_wrong += verdict != "same"
        print(f"{name:36} {one['n']:>9} {one['of']:36} {verdict}")
    n_all = len(a["entries"] | b["entries"])
    print(f"{n_all - n_wrong} of {n_all} the same")
    return int(n_wrong > 0 or n_all == 0)


def main() -> int:
    """Read the command line; compare, or measure and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", help="for databases; kept")
    parser.add_argument("--out", type=Path, help="JSON to write")
    parser.add_argument("--replay", type=Path, nargs="+", default=[], help="recordings to feel")
    parser.add_argument("--poses", type=int, default=1000, help="poses of a touch")
    parser.add_argument("--quick", action="store_true", help="bricks on SQLite alone: a minute")
    parser.add_argument("--compare", type=Path, nargs=2, metavar="JSON", help="of two commits")
    chosen = parser.parse_args()
    if chosen.compare:
        return compare(chosen.compare)
    if chosen.folder is None or chosen.out is None:
        parser.error("give a folder and --out, or --compare")
    folder, results = chosen.folder.resolve(), Results(chosen.out, versions())
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as servers:
        places = import_car(folder, servers, is_quick=chosen.quick)
        measure(folder, places, chosen.replay, chosen.poses, results)
    return int(any(entry["differing"] or not entry["n"] for entry in results.values()))


if __name__ == "__main__":
    raise SystemExit(main())
