"""An environment whose rows lie on three other servers, by postgres_fdw."""

import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psycopg
import pytest

import hapticdb
from assemblies import ball
from command_line import Run, refused
from contract.store import StoreContract
from crashes import EDITS, N_PARTS, After, Killer, crash, felt, options, running
from hapticdb import Grid, PointShell
from hapticdb.errors import AccessError, ConnectionLostError, EnvironmentExistsError, UsageError
from hapticdb.paper.strategies import STRATEGIES, Strategy
from hapticdb.store.base import Columns, Layout
from hapticdb.store.connect import grant
from hapticdb.store.postgres import environment_schema
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.partitions import ends
from hapticdb.store.postgres.postgres_store import PostgresStore
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.server_tables import ServerTables
from hapticdb.store.urls import redact, with_partitions
from postgres_servers import Binaries, Server
from servers import SETTINGS, Place, kill
from validity import Contents, contents, valid_contents

pytestmark = pytest.mark.long


class Spread(NamedTuple):
    """A server, and three more for the rows of its environments."""

    server: Server
    partitions: tuple[Server, ...]

    def url(self, name: str) -> str:
        """URL of an environment that is to be made on the partitions."""
        parts = ",".join(one.conninfo() for one in self.partitions)
        return with_partitions(f"{self.server.conninfo()}&environment={name}", parts)


@pytest.fixture(scope="module")
def spread(template: tuple[Path, Binaries]) -> Iterator[Spread]:
    with contextlib.ExitStack() as ending:
        first, *others = (ending.enter_context(running(template, SETTINGS)) for _ in range(4))
        yield Spread(first, tuple(others))


def dropped(url: str) -> None:
    with environment_schema.connected(url) as connection:
        environment_schema.drop(connection)


@pytest.fixture
def made(spread: Spread, file: Path) -> Iterator[str]:
    """URL of thirty balls on the partitions."""
    url = spread.url("balls")
    hapticdb.import_files(url, [file], options("brick"))
    yield url
    dropped(url)


@pytest.fixture
def new_url(spread: Spread) -> Iterator[Place]:
    urls: list[str] = []

    def new() -> str:
        urls.append(spread.url(f"environment_{len(urls)}"))
        return urls[-1]

    yield new
    for url in urls:
        dropped(url)


class TestPartitionedStore(StoreContract):
    pass


@pytest.mark.parametrize("layout", ["voxel", "brick"])
def test_partitions_frames_equal_one_server(
    spread: Spread, file: Path, undisturbed: dict[Layout, Contents], layout: Layout
) -> None:
    url = spread.url("frames")
    hapticdb.import_files(url, [file], options(layout))
    assert valid_contents(url) == undisturbed[layout]
    points, faces = ball((0, 0, 0), 0.15, 24)
    shell = PointShell.from_mesh(points, faces, 200, seed=1)
    poses = [np.eye(4) for _ in range(2)]
    for n, pose in enumerate(poses):
        pose[:3, 3] = (0.2 * n - 0.2, 0.1 * n, -0.1)
    with hapticdb.open(url) as env, hapticdb.open(file.with_name(f"{layout}.db")) as one:
        for strategy in STRATEGIES if layout == "brick" else ("array", "statement"):
            found = [felt(env, shell, pose, strategy) for pose in poses]
            assert found == [felt(one, shell, pose, strategy) for pose in poses]
            assert any(len(hits) for _, hits, _ in found)
        if layout == "brick":
            cells = env.batch_tool(shell), one.batch_tool(shell)
            both = [batch_tool.touch(np.array(poses)).forces.tobytes() for batch_tool in cells]
            assert both[0] == both[1]
    dropped(url)


def plan(url: str, text: str, *parameters: wire.Parameter) -> str:
    with hapticdb.open(url, read_only=True) as env:
        assert isinstance(env.store, PostgresStore)
        connection = env.store._connection
        found = connection.run(f"EXPLAIN (ANALYZE, VERBOSE, COSTS OFF) {text}", parameters)
        lines = [found.get_value(row, 0) or b"" for row in range(found.ntuples)]
        return b"\n".join(lines).decode()


def remote(text: str) -> list[str]:
    """Statements that were sent, each once: of scans that were executed."""
    lines = text.splitlines()
    sent = [n for n, line in enumerate(lines) if "Remote SQL" in line]
    return [lines[n].split("Remote SQL: ")[1] for n in sent if not _is_idle(lines, n)]


def _is_idle(lines: list[str], n: int) -> bool:
    node = next(line for line in reversed(lines[:n]) if "Foreign Scan" in line)
    return "never executed" in node


def test_partitions_reads_reach_needed_servers_only(made: str) -> None:
    with hapticdb.open(made, read_only=True) as env:
        first, second = ends(env.grid, "brick", 3)
        keys = env.store.scan(np.array([0]), np.array([first - 1])).keys[:3]
    asked: tuple[Columns, ...] = "brick", "distances"
    for columns in asked:
        text = plan(made, statements.PARTITIONED.lookup[columns], wire.int8s(keys))
        assert all("(z_val = ANY (" in sent for sent in remote(text))
        assert len(remote(text)) == 1
        lows, highs = np.array([3, second + 2]), np.array([first - 2, second + 9])
        text = plan(made, statements.PARTITIONED.scan[columns], wire.int8s(lows), wire.int8s(highs))
        assert len(remote(text)) == 2
        assert all("z_val >= $1" in sent and "z_val <= $2" in sent for sent in remote(text))
    everywhere = wire.int8s(np.array([1, first + 1, second + 1]))
    assert (
        plan(made, statements.PARTITIONED.lookup["brick"], everywhere).count("Async Foreign") == 3
    )


def test_partitions_repair_after_crash(
    made: str, spread: Spread, undisturbed: dict[Layout, Contents], run: Run
) -> None:
    shell = PointShell.from_mesh(*ball((0, 0, 0), 0.2, 24), 200, seed=1)
    asked: tuple[Strategy, ...] = ("array", "maxgap", "statement")
    with hapticdb.open(made) as env:
        before = [felt(env, shell, np.eye(4), strategy) for strategy in asked]
    with psycopg.connect(spread.partitions[1].conninfo(), autocommit=True) as partition:
        partition.execute(
            "INSERT INTO balls.brick"
            " SELECT DISTINCT ON (z_val) z_val, 77, occupancy, distances FROM balls.brick"
        )
    with hapticdb.open(made, read_only=True) as env:
        assert [felt(env, shell, np.eye(4), strategy) for strategy in asked] == before
    with psycopg.connect(spread.partitions[0].conninfo(), autocommit=True) as partition:
        partition.execute("DELETE FROM balls.brick WHERE id = 3")
    code, out, _ = run("check", made)
    assert code == 1
    assert "rows of object 77, which is not there" in out
    assert "'--repair' mends rows" in out
    code, out, err = run("check", made, "--repair")
    assert (code, "is sound" in out) == (0, True), (out, err)
    assert valid_contents(made)[2] == undisturbed["brick"][2]


@pytest.mark.parametrize("step", ["_take", "_put"])
def test_partitions_lost_server_in_write_rolls_back(
    made: str, spread: Spread, edited: list[Contents], monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    dying = spread.partitions[1]
    _, edit = EDITS[0]
    with hapticdb.open(made) as env:
        before = contents(env)
        with monkeypatch.context() as patch:
            After(patch, ServerTables, step, lambda: kill(dying))
            with pytest.raises(
                ConnectionLostError, match="one of its partitions cannot be reached"
            ):
                edit(env)
        with pytest.raises(ConnectionLostError, match="one of its partitions cannot be reached"):
            env.store.size()
        dying.start()
        assert contents(env)[:2] == before[:2]
        edit(env)  # rows that the other partitions had committed are in nobody's way
    assert valid_contents(made)[2] == edited[0][2]


def test_partitions_import_resumes_after_crashes(
    spread: Spread, file: Path, undisturbed: dict[Layout, Contents], run: Run
) -> None:
    url = spread.url("cut")
    for n, server in enumerate((spread.server, *spread.partitions)):
        progress = Killer(3 + n * (N_PARTS // 5), 0.01 * n, partial(crash, server))
        with contextlib.suppress(ConnectionLostError):
            hapticdb.import_files(url, [file], options("brick"), progress)
        progress.joined()
    hapticdb.import_files(url, [file], options("brick"))
    assert run("check", url, "--repair")[0] == 0
    rows = [(key, packed) for key, _, packed in sorted(valid_contents(url)[2])]
    assert rows == [(key, packed) for key, _, packed in sorted(undisturbed["brick"][2])]
    dropped(url)


def test_partitions_roles(made: str, spread: Spread) -> None:
    with psycopg.connect(spread.server.conninfo(), autocommit=True) as server:
        server.execute("CREATE ROLE guest LOGIN")
    guest = made.replace("user=hapticdb", "user=guest", 1)
    shell = PointShell.from_mesh(*ball((0, 0, 0), 0.2, 24), 200, seed=1)
    with pytest.raises(AccessError, match="may not read"):
        hapticdb.open(guest, read_only=True)
    grant(made, "guest", "viewer")
    with hapticdb.open(guest, read_only=True) as env, hapticdb.open(made) as owner:
        assert felt(env, shell, np.eye(4)) == felt(owner, shell, np.eye(4))
        with pytest.raises(hapticdb.errors.ReadOnlyError):
            hapticdb.open(guest).remove(1)
    grant(made, "guest", "editor")
    with hapticdb.open(guest) as env:
        env.remove(1)
    grant(made, "guest", "nobody")
    with psycopg.connect(spread.server.conninfo(), autocommit=True) as server:
        server.execute("DROP ROLE guest")


def test_partitions_bad_arguments(made: str, spread: Spread, file: Path, run: Run) -> None:
    one = spread.partitions[0].conninfo()
    line = "only environments on PostgreSQL have partitions"
    refused(run("import", file.with_name("x.db"), file, "--partitions", "a"), line)
    with pytest.raises(EnvironmentExistsError, match="exists already"):
        hapticdb.create(made, Grid(0.005, (0, 0, 0), 6))
    where = with_partitions(f"{one}&environment=balls2", f"{one},{one}")
    with pytest.raises(EnvironmentExistsError, match="exists already on this partition"):
        hapticdb.create(where, Grid(0.005, (0, 0, 0), 6))
    with pytest.raises(UsageError, match="too few for 2 partitions"):
        hapticdb.create(
            with_partitions(f"{one}&environment=few", f"{one},{one}"), Grid(0.1, (0, 0, 0), 3)
        )
    with psycopg.connect(one) as server:
        left = "SELECT count(*) FROM pg_namespace WHERE nspname IN ('balls2', 'few')"
        assert server.execute(left).fetchone() == (0,)
    assert "secret" not in redact(with_partitions("postgresql:///a", "postgresql://me:secret@h/b"))
