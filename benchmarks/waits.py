"""What people wait for: seconds, processor time and memory of every verb, and of twenty pulls.

    make waits                                              # clashes and hands, too
    python benchmarks/waits.py [--old CHECKOUT] [--rounds 3]

First: the first command of a new copy of the package, with the kernels of a wheel and an empty
cache. Again: the same command on the same state; with another checkout, in turns. Each is a process
of its own, on the sample; `view` and `serve` end when their page answers. Processor time is without
the loop of `feel`. A pull is `extract` of a part of an assembly not made by us, straight alone.
"""

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import page_tables
import records

LONGEST_S = 300.0
"""Seconds after which a command is killed."""
COMMANDS = """\
import new.db ../car.glb --bits 9 --extent 1.6
info car.db
objects car.db
touch car.db --tool ../spanner.stl --poses ../path.csv
feel car.db --tool ../spanner.stl --device ../path.csv --seconds 0.2
view car.db --no-browser
serve car.db
replay session.hdbrec car.db
sweep car.db --part body/hood --path ../up.csv
reach car.db wheels/wheel_bolt_front_left_1 --tool ../spanner.stl
clashes car.db
distance car.db body/hood body/windscreen
extract car.db wheels/wheel_bolt_front_left_1
move car.db body/hood --translate 0,0,0.1
remove car.db body/hood
copy car.db other.db --curve hilbert
diff car.db same.db
check car.db
backup car.db monday.db
sample made
demo""".splitlines()
"""All verbs but `grant`, which needs a server."""
PULL = "extract scene.db {} --motions 0"
SCENES = {
    "vintage car": ("demo_vintage_car/vintage_car.glb", 7),
    "van": ("assembly_vw_t1/vw_t1.glb", 7),
    "LeKiwi": ("robot_lekiwi/lekiwi.glb", 6),
}
"""Files below the folder that HAPTICDB_TEST_DATA names, and numbers of pulls."""


class Spent(NamedTuple):
    """Costs and exit code; the peak is the largest process's, at least this one's, 24 MB."""

    s: float
    cpu_s: float
    peak_mb: float
    code: int


def timed(folder: Path, command: str, **variables: str) -> Spent:
    """Run a command of hapticdb in a folder; what it says is in said.txt."""
    words, said, answered = command.split(), folder / "said.txt", 0.0
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": ""} | variables
    began, until = time.perf_counter(), time.monotonic() + LONGEST_S
    with said.open("w") as out:
        line = [sys.executable, "-m", "hapticdb", *words]
        process = subprocess.Popen(line, cwd=folder, env=env, stdout=out, stderr=out)
    limit = threading.Timer(LONGEST_S, process.kill)
    limit.start()
    if words[0] in {"view", "serve"}:
        while (
            not (found := re.findall(r"http://\S+", said.read_text())) and time.monotonic() < until
        ):
            time.sleep(0.01)
        urllib.request.urlopen(found[0], timeout=LONGEST_S).close()  # noqa: S310 - http
        answered = time.perf_counter() - began
        process.terminate()  # a shell's background ignores interrupts, and children inherit that
    _, status, used = os.wait4(process.pid, 0)
    wall = answered or time.perf_counter() - began
    limit.cancel()
    process.returncode = os.waitstatus_to_exitcode(status)
    told, answers = said.read_text(), {0, 1, 3, 4, 143}  # and the end of a page
    if process.returncode not in answers or "shows where" in told:  # an unexpected error is 1, too
        raise SystemExit(f"{command}: {process.returncode}: {told}")
    return Spent(wall, used.ru_utime + used.ru_stime, used.ru_maxrss * 1.024e-3, process.returncode)


def prepare(side: Path) -> None:
    """Copy the package as a wheel has it, with the sample: in a process of its checkout."""
    import hapticdb  # noqa: PLC0415 - the memory of this file's process stays small
    from hapticdb.kernels._machine_code import GROUPS  # noqa: PLC0415
    from hapticdb.kernels._sets import fitting_set  # noqa: PLC0415
    from hapticdb.sample import write_sample  # noqa: PLC0415

    ignored = shutil.ignore_patterns("__pycache__", "_machine")
    shutil.copytree(Path(hapticdb.__file__).parent, side / "hapticdb", ignore=ignored)
    for group in GROUPS:
        built, _ = fitting_set(group)  # type: ignore[misc]  # built if need be
        shutil.copytree(built, side / "hapticdb/kernels/_machine" / group)
    write_sample(side)
    (side / "up.csv").write_text("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n0,0,0.3,1,0,0,0\n")


def run(side: Path, command: str, *, is_first: bool) -> Spent:
    """Run a command on the same state, `made`."""
    if is_first:
        for kept in (*side.glob("hapticdb/**/__pycache__"), side / "cache"):
            shutil.rmtree(kept, ignore_errors=True)
    shutil.rmtree(side / "run", ignore_errors=True)
    shutil.copytree(side / "made", side / "run")
    cache = str(side / "cache")
    return timed(side / "run", command, PYTHONPATH=str(side), NUMBA_CACHE_DIR=cache)


def measure(
    folder: Path, checkouts: dict[str, Path], rounds: int, commands: Sequence[str]
) -> list[dict[str, Any]]:
    """Medians of each command, first and again, on each side."""
    cells = []
    for name, checkout in checkouts.items():
        (made := folder / name / "made").mkdir(parents=True)
        words = [sys.executable, __file__, "--prepare", str(folder / name)]
        path = {"PYTHONPATH": str(checkout / "src")}
        subprocess.run(words, env=os.environ | path, check=True, timeout=LONGEST_S)
        timed(made, COMMANDS[0].replace("new", "car"), **path)
        timed(made, f"{COMMANDS[4]} --record session.hdbrec", **path)
        shutil.copy(made / "car.db", made / "same.db")
    for command in commands:
        found: dict[tuple[str, bool], list[Spent]] = {}
        for _ in range(rounds):
            for side in checkouts:
                for is_first in (True, False):
                    spent = run(folder / side, command, is_first=is_first)
                    found.setdefault((side, is_first), []).append(spent)
        for side in checkouts:
            cell: dict[str, Any] = {"command": command, "side": side}
            for turn, is_first in (("first", True), ("again", False)):
                middles = map(statistics.median, zip(*found[side, is_first], strict=True))
                cell[turn] = dict(zip(Spent._fields, middles, strict=True))
            cells.append(cell)
            print(cells[-1], flush=True)
    return cells


def pulls(folder: Path) -> list[dict[str, Any]]:
    """Pulls of every n-th part of each assembly."""
    cells = []
    for scene, (file, n_pulls) in SCENES.items():
        (made := folder / scene).mkdir()
        (made / "scene.glb").symlink_to(Path(os.environ["HAPTICDB_TEST_DATA"], file))
        timed(made, "import scene.db scene.glb --bits 9")
        timed(made, "objects scene.db --json")
        n_parts = len((made / "said.txt").read_text().splitlines())
        for part in range(n_parts // n_pulls, n_parts + 1, n_parts // n_pulls)[:n_pulls]:
            cells.append({"scene": scene, "part": part, **timed(made, PULL.format(part))._asdict()})
            print(cells[-1], flush=True)
    return cells


def main() -> None:
    """Measure, write the results, and fill the page's tables."""
    parser = argparse.ArgumentParser(description=records.first_line(__doc__))
    parser.add_argument("--old", type=Path, help="another checkout, measured in turns")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--prepare", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.prepare:
        prepare(asked.prepare)
        return
    sides = {"this": records.ROOT} | ({"old": asked.old.resolve()} if asked.old else {})
    with tempfile.TemporaryDirectory(prefix="hapticdb-waits-") as folder:
        cells = measure(Path(folder), sides, asked.rounds, COMMANDS)
        page_tables.publish("waits", cells, {"rounds": asked.rounds})
        page_tables.publish("pulls", pulls(Path(folder)), {"command": PULL.format("PART")})


if __name__ == "__main__":
    main()
