"""PostgreSQL, every version found: strategies, layouts, forms of Figure 3, costs of choices.

The server is private and local, reached by a Unix socket; all pages are cached. During measurements
a process of idle priority keeps each processor awake; without it, times double and scatter (the
module `awake` says why).

    make bench                      # beside the frames on SQLite, over the same scene and poses
"""

import contextlib
import itertools
import shutil
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

import hapticdb
from awake import awake
from hapticdb import Environment, Touch
from hapticdb.kernels.query import contact
from hapticdb.query.frame import STRATEGIES, Strategy
from hapticdb.store.base import LAYOUTS, Layout, LocatedShell, row_shift
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.private_server import Binaries, PrivateServer
from hapticdb.store.postgres.schema_of import drop
from hapticdb.store.postgres.store import PostgresStore
from hapticdb.store.postgres.tables import statements
from scene import BenchScene, is_measuring
from servers import FOUND, named

ROUNDS = 5
SETTINGS = {"shared_buffers": "1GB", "max_wal_size": "4GB"}
# the same wrench by built-in sums, to compare their cost with the aggregate force()
SUMS = """
SELECT sum(fx), sum(fy), sum(fz),
       sum(ry * fz - rz * fy), sum(rz * fx - rx * fz), sum(rx * fy - ry * fx)
  FROM (SELECT $11 * depth * nx AS fx, $11 * depth * ny AS fy, $11 * depth * nz AS fz,
               x - $8 AS rx, y - $9 AS ry, z - $10 AS rz
          FROM (SELECT hit.*, (ox + s * (floor((x - ox) / s) + 0.5) - x) * nx
                            + (oy + s * (floor((y - oy) / s) + 0.5) - y) * ny
                            + (oz + s * (floor((z - oz) / s) + 0.5) - z) * nz AS depth
                  FROM (SELECT ($2)[n] AS x, ($3)[n] AS y, ($4)[n] AS z,
                               ($5)[n] AS nx, ($6)[n] AS ny, ($7)[n] AS nz
                          FROM unnest($1) WITH ORDINALITY AS shell(key, n)
                         WHERE {exists} OFFSET 0) AS hit,
                       (SELECT origin_x AS ox, origin_y AS oy, origin_z AS oz, voxel_size AS s
                          FROM environment) AS grid OFFSET 0) AS found
         WHERE depth > 0 OFFSET 0) AS contact"""
JOINED = {
    layout: f"""
SELECT {statements.PACKED[layout]}, {statements.SEEN}
  FROM unnest($1) AS asked(key) JOIN {layout} ON z_val = asked.key"""
    for layout in LAYOUTS
}


@pytest.fixture(scope="module", autouse=True)
def _awake(pytestconfig: pytest.Config) -> Iterator[None]:
    """Keep processors awake while times are measured."""
    with awake() if is_measuring(pytestconfig) else contextlib.nullcontext():
        yield


class Served:
    """The benchmark's scene on one server, in both layouts."""

    def __init__(self, found: Binaries | str, scene: BenchScene, bits: int) -> None:
        self._server: PrivateServer | None = None
        if isinstance(found, str):
            url = found
        else:
            folder = tempfile.mkdtemp(prefix="hapticdb-bench-")
            self._server = PrivateServer.at(folder, found, SETTINGS)
            self._server.start()
            url = self._server.conninfo()
        self.base = url
        self.environments: dict[Layout, Environment] = {}
        for layout in LAYOUTS:
            options = hapticdb.ImportOptions(
                grid=hapticdb.GridOptions(bits=bits, extent=1.6), layout=layout, distances=False
            )
            where = with_environment(url, f"bench_{layout}")
            (report,) = hapticdb.import_files(where, [scene.files.car], options)
            assert report.status == "imported"
            self.environments[layout] = hapticdb.open(where)

    def session(self, layout: Layout) -> ServerConnection:
        store = self.environments[layout].store
        assert isinstance(store, PostgresStore)
        return store.connection

    def end(self) -> None:
        for layout, env in self.environments.items():
            if self._server is None:
                drop(self.session(layout))
            env.close()
        if self._server is not None:
            self._server.stop()
            shutil.rmtree(self._server.folder)


@pytest.fixture(scope="module", params=FOUND, ids=named)
def served(request: pytest.FixtureRequest, scene: BenchScene, bits: int) -> Iterator[Served]:
    made = Served(request.param, scene, bits)
    yield made
    made.end()


def measure(
    benchmark: BenchmarkFixture, poses: list[Any], frame: Callable[[Any], object], group: str
) -> None:
    """Measure the median time of a frame over passes through all poses."""
    times: list[float] = []

    def once() -> None:
        for pose in poses:
            start = time.perf_counter_ns()
            frame(pose)
            times.append((time.perf_counter_ns() - start) / 1000)

    benchmark.group = group
    benchmark.pedantic(once, rounds=ROUNDS, warmup_rounds=1)
    counted = times[len(poses) :] or times  # the first pass is the warm-up
    benchmark.extra_info["us_per_frame"] = round(float(np.median(counted)), 1)
    benchmark.extra_info["p99_us"] = round(float(np.percentile(counted, 99)), 1)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_touch(
    benchmark: BenchmarkFixture,
    scene: BenchScene,
    served: Served,
    strategy: Strategy,
    layout: Layout,
) -> None:
    env = served.environments[layout]
    if env.store.costs("bench") is None:
        env.calibrate(keep=False)
        env.store.save_costs("bench", {"done": 1.0})
    poses = scene.poses[:: 20 if strategy == "points" else 1]
    measure(
        benchmark, poses, lambda pose: env.touch(scene.shell, pose, strategy), f"{layout} frame"
    )
    queries = [env.touch(scene.shell, pose, strategy).query for pose in poses]
    for name in ("statements", "ranges", "rows"):
        benchmark.extra_info[name] = float(np.mean([getattr(q, name) for q in queries]))
    chosen = [q.strategy for q in queries]
    benchmark.extra_info["chosen"] = {name: chosen.count(name) for name in sorted(set(chosen))}
    for pose in poses[::20]:
        wanted = scene.environments[layout].touch(scene.shell, pose)
        assert env.touch(scene.shell, pose, strategy).force.tobytes() == wanted.force.tobytes()


def wrench_of(touch: Touch) -> NDArray[np.float64]:
    """Force and torque (6,) of a touch."""
    return np.concatenate([touch.force, touch.torque])


def frames_of(scene: BenchScene, env: Environment) -> list[LocatedShell]:
    """Located shells along the path, in the form that a store gets."""
    grid = env.grid
    origin = np.array(grid.origin)
    shift = row_shift(env.layout)
    none = np.empty(0, dtype=np.int64)
    curve = grid.bits, grid.curve_code, shift
    shell = scene.shell
    found = []
    for pose in scene.poses[::4]:
        placed, asked, _ = contact.locate(
            shell.points, shell.normals, shell.center, pose, origin, grid.voxel_size, *curve
        )
        found.append(LocatedShell(placed, asked[0], 1000.0, none))
    return found


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("form", ["exists alone", "built-in sums", "force()"])
def test_figure_3(
    benchmark: BenchmarkFixture, scene: BenchScene, served: Served, form: str, layout: Layout
) -> None:
    """Cost of the paper's aggregate, beside the hits alone and beside the engine's own sums."""
    session = served.session(layout)
    force = statements.WRENCH[layout]
    exists = force.partition("WHERE ")[2]
    text = {
        "exists alone": "SELECT count(*) FROM unnest($1) AS shell(key) WHERE " + exists,
        "built-in sums": SUMS.format(exists=exists),
        "force()": force,
    }[form]
    asked = [wire.shell(frame) for frame in frames_of(scene, served.environments[layout])]
    n_parameters = 1 if form == "exists alone" else None
    measure(
        benchmark,
        [parameters[:n_parameters] for parameters in asked],
        lambda parameters: session.fetch(text, *parameters),
        f"{layout} figure 3",
    )
    env = scene.environments[layout]
    for pose, parameters in list(zip(scene.poses[::4], asked, strict=True))[::5]:
        wanted = env.touch(scene.shell, pose, "array")
        found = session.fetch(text, *parameters[:n_parameters])
        if form == "exists alone":
            assert wire.read_int8(found[0] or b"") == len(wanted.hits)
        elif form == "force()":
            wrench = np.zeros(6) if found[0] is None else wire.read_float8s(found[0])
            assert wrench.tobytes() == wrench_of(wanted).tobytes()
        else:  # sums in the engine's order, without force()'s average
            sums = [0.0 if one is None else struct.unpack(">d", one)[0] for one in found]
            tenths = max(1.0, len(wanted.hits) / 10)
            np.testing.assert_allclose(
                np.array(sums) / tenths, wrench_of(wanted), rtol=1e-9, atol=1e-9
            )


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("form", ["any", "join"])
def test_forms_of_a_lookup(
    benchmark: BenchmarkFixture, scene: BenchScene, served: Served, form: str, layout: Layout
) -> None:
    """Keys as one array for an index scan, or as rows of a join with one descent for each."""
    session = served.session(layout)
    text = statements.LOOKUP[layout] if form == "any" else JOINED[layout]
    shift = row_shift(layout)
    asked = [
        wire.int8s(np.unique(frame.addresses[frame.addresses >= 0] >> shift))
        for frame in frames_of(scene, served.environments[layout])
    ]
    measure(benchmark, asked, lambda keys: session.fetch(text, keys), f"{layout} lookup")
    both = [session.fetch(t[layout], asked[0])[0] for t in (statements.LOOKUP, JOINED)]
    assert sorted(wire.read_int8s(both[0])) == sorted(wire.read_int8s(both[1]))


@pytest.mark.parametrize("form", ["key alone", "including occupancy"])
def test_occupancy_in_the_index(
    benchmark: BenchmarkFixture, scene: BenchScene, served: Served, form: str
) -> None:
    """Frames with an index that includes all occupancy, against an index of keys alone."""
    env = served.environments["brick"]
    session = served.session("brick")
    if form != "key alone":
        session.command("CREATE INDEX bench_wide ON brick (z_val, id) INCLUDE (occupancy)")
        session.command("DROP INDEX brick_key")
    session.command("VACUUM brick")
    try:
        measure(
            benchmark,
            scene.poses,
            lambda pose: env.touch(scene.shell, pose, "array"),
            "brick index",
        )
        which = "brick_key" if form == "key alone" else "bench_wide"
        rows = session.execute("SELECT pg_relation_size(%s::regclass)", (which,)).fetchall()
        benchmark.extra_info["index_bytes"] = rows[0][0]
        for pose in scene.poses[::20]:
            wanted = scene.environments["brick"].touch(scene.shell, pose)
            found = env.touch(scene.shell, pose, "array")
            assert wrench_of(found).tobytes() == wrench_of(wanted).tobytes()
    finally:
        if form != "key alone":
            session.command("CREATE UNIQUE INDEX brick_key ON brick (z_val, id)")
            session.command("DROP INDEX bench_wide")


@pytest.mark.parametrize("form", ["one statement", "in a snapshot"])
def test_snapshot(benchmark: BenchmarkFixture, served: Served, form: str) -> None:
    """Cost of REPEATABLE READ for a frame of several statements: a BEGIN and a COMMIT."""
    session = served.session("brick")

    def alone(_: object) -> None:
        session.fetch("SELECT 1::bigint")

    def inside(_: object) -> None:
        with session.snapshot():
            session.fetch("SELECT 1::bigint")

    run = alone if form == "one statement" else inside
    measure(benchmark, list(range(200)), run, "round trips")
    assert session.fetch("SELECT 1::bigint") == [bytes(7) + b"\1"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_import_beside_sqlite(
    benchmark: BenchmarkFixture,
    scene: BenchScene,
    served: Served,
    bits: int,
    tmp_path: Path,
    layout: Layout,
) -> None:
    """Import the same file into both engines, in turns."""
    options = hapticdb.ImportOptions(
        grid=hapticdb.GridOptions(bits=bits, extent=1.6), layout=layout, distances=False
    )
    times: dict[str, list[float]] = {"sqlite": [], "postgres": []}
    numbers = itertools.count()

    def both() -> None:
        n = next(numbers)
        there = with_environment(served.base, f"bench_import_{n}")
        for name, url in (("sqlite", str(tmp_path / f"{n}.db")), ("postgres", there)):
            start = time.perf_counter()
            hapticdb.import_files(url, [scene.files.car], options)
            times[name].append(time.perf_counter() - start)
        with hapticdb.open(there) as env, hapticdb.open(tmp_path / f"{n}.db") as file:
            counted, wanted = ({o.name: o.voxels for o in one.objects()} for one in (env, file))
            assert counted == wanted
            assert isinstance(env.store, PostgresStore)
            drop(env.store.connection)

    benchmark.group = f"{layout} import"
    benchmark.pedantic(both, rounds=3, warmup_rounds=1)
    seconds: NDArray[np.float64] = np.array([times["sqlite"], times["postgres"]])
    seconds = seconds[:, 1:] if seconds.shape[1] > 1 else seconds
    for name, values in zip(times, seconds, strict=True):
        benchmark.extra_info[f"{name}_s"] = round(float(np.median(values)), 2)
    ratio = np.median(seconds[1] / seconds[0])
    benchmark.extra_info["times_as_long"] = round(float(ratio), 2)
