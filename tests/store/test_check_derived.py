"""`hapticdb check` finds what is not what it derives from: each column, altered by itself."""

import contextlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import apsw
import numpy as np
import psycopg
import pytest
from psycopg import sql

import hapticdb
from assemblies import row_of_boxes
from hapticdb.check import check_environment, repair_environment
from hapticdb.clashes.search import accept_clash, find_clashes
from hapticdb.store.postgres.address import parse
from postgres_servers import Binaries
from servers import FOUND, named, url_on

TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
SIDES = np.array([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]])
ALTERED: dict[str, tuple[str, np.ndarray | None]] = {
    "transform": ("UPDATE object SET transform = ? WHERE id = 2", TURNED),
    "no placement": ("UPDATE object SET transform = ? WHERE id = 2", np.ones((4, 4))),
    "out of the grid": ("UPDATE object SET transform = ? WHERE id = 2", 99.0 * np.eye(4)),
    "bounds": ("UPDATE object SET bounds = ? WHERE id = 2", SIDES),
    "digest": ("UPDATE object SET digest = 'x' WHERE id = 2", None),
    "voxels": ("UPDATE object SET voxels = voxels + 1 WHERE id = 2", None),
    "revision": ("UPDATE object SET revision = revision + 1 WHERE id = 2", None),
    "voxel_size": ("UPDATE environment SET voxel_size = 1.5 * voxel_size", None),
    "origin": ("UPDATE environment SET origin_y = origin_y + 0.5", None),
    "curve": ("UPDATE environment SET curve = 'hilbert'", None),
    "layout": ("UPDATE environment SET layout = 'voxel'", None),
    "rule": ("INSERT INTO rule VALUES (1, 'a', '*', 'meant', 'no kind', NULL, '')", None),
    "clearance": ("INSERT INTO rule VALUES (1, 'a', '*', 'apart', '', NULL, '')", None),
    "a": ("UPDATE pair SET a = 1 WHERE a = 2 AND b = 3", None),
    "b": ("UPDATE pair SET b = 9 WHERE a = 1 AND b = 2", None),
    "kind": ("UPDATE pair SET kind = 'touching' WHERE a = 1", None),
    "far": ("UPDATE pair SET kind = 'far' WHERE a = 1", None),
    "at_least": ("UPDATE pair SET at_least = 2 * at_least WHERE a = 1", None),
    "at_most": ("UPDATE pair SET at_most = at_most + 0.001 WHERE a = 1", None),
    "no bound": ("UPDATE pair SET at_most = NULL WHERE a = 1", None),
    "place": ("UPDATE pair SET a_x = a_x + 1, b_x = b_x + 1 WHERE a = 1", None),
    "pair's revision": ("UPDATE pair SET revision = 99 WHERE a = 1", None),
    "setting": ("UPDATE pair SET setting = 'x' WHERE a = 1", None),
    "because": ("UPDATE pair SET because = 'x' WHERE a = 2", None),
    "a pair that is gone": ("DELETE FROM pair WHERE a = 1", None),
}  # fmt: skip
OF_PAIRS = list(ALTERED)[list(ALTERED).index("a") :]
ON_SERVERS = ["transform", "bounds", "voxels", "rule", "kind", "no bound", "place", "because"]
"""Columns of each type, which a server's rows are parsed from; what is compared is the same."""


def on_engines(names: list[str]) -> pytest.MarkDecorator:
    """Those columns on SQLite, some of them on the servers."""
    found: list[tuple[Binaries | None, str]] = [(None, name) for name in names]
    found += [(engine, name) for engine in FOUND for name in names if name in ON_SERVERS]
    ids = [f"{named(engine)}-{name}" for engine, name in found]
    return pytest.mark.parametrize(("engine", "name"), found, ids=ids)


def searched(url: str | Path) -> None:
    """Cubes 1 and 2 overlap by 1 mm, and so do 2 and 3; the first pair is accepted."""
    with hapticdb.open(url) as env:
        find_clashes(env)
        accept_clash(env, [1], [2], "meant so")


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return row_of_boxes(tmp_path_factory.mktemp("row") / "row.db", 3, 0.099)


@contextlib.contextmanager
def altered(engine: Binaries | None, folder: Path, row: Path, name: str) -> Iterator[str]:
    """URL of the row, searched, with a column altered."""
    with url_on(engine, folder) as url:
        hapticdb.copy_environment(row, url)
        searched(url)
        alter(url, name)
        yield url


def alter(url: str, name: str) -> None:
    statement, array = ALTERED[name]
    if "://" not in url:
        with closing(apsw.Connection(url)) as connection:
            connection.execute("PRAGMA ignore_check_constraints = ON")
            connection.execute(statement, () if array is None else (array.tobytes(),))
        return
    address = parse(url)
    with psycopg.connect(address.conninfo, autocommit=True) as server:
        schema = sql.Identifier(address.environment)
        server.execute(sql.SQL("SET search_path = {}").format(schema))
        given = () if array is None else (array.ravel().tolist(),)
        server.execute(statement.replace("?", "%s").encode(), given)


@on_engines(list(ALTERED))
def test_check_environment_altered_column(
    tmp_path: Path, row: Path, engine: Binaries | None, name: str
) -> None:
    with altered(engine, tmp_path, row, name) as url:
        report = check_environment(url)
        assert not report.is_sound
        assert all("\n" not in finding for finding in report.findings)


@on_engines(["bounds", *OF_PAIRS])
def test_repair_environment_derived_columns(
    tmp_path: Path, row: Path, engine: Binaries | None, name: str
) -> None:
    """Pairs, by the next search; the accepted pair stays accepted where its row is there."""
    with altered(engine, tmp_path, row, name) as url:
        repair_environment(url, check_environment(url))
        with hapticdb.open(url) as env:
            found = find_clashes(env)
        assert check_environment(url).findings == []
        assert found.counts()["overlapping"] == 2
        lost = {"a", "b", "pair's revision", "because", "a pair that is gone"}
        if name not in lost:
            assert [one.because for one in found.pairs if one.a == 1] == ["meant so"]


def test_check_environment_sound_after_move_and_remove(tmp_path: Path) -> None:
    path = row_of_boxes(tmp_path / "row.db", 4, 0.099)
    searched(path)
    with hapticdb.open(path) as env:
        env.shift([2], (0.0, 0.3, 0.01))
        env.remove(4)
        assert check_environment(path).findings == []
        find_clashes(env)
    assert check_environment(path).findings == []
