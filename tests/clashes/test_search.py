"""The table of pairs: what is kept, what is measured again, and what is said of it."""

import os
import re
import signal
import sqlite3
import sys
import threading
import time
from collections.abc import Collection
from contextlib import closing
from pathlib import Path

import numpy as np
import psycopg
import pytest
import trimesh
from psycopg import sql

import hapticdb
from assemblies import row_of_boxes
from children import finished, joined
from hapticdb import Environment, accept_clash, find_clashes
from hapticdb.clashes import search
from hapticdb.clashes.clash_results import Clashes
from hapticdb.errors import UsageError
from hapticdb.exact.clash import Floats, PairResult, classify_pair
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.store.connect import grant
from hapticdb.store.pairs import PairRow
from hapticdb.store.postgres.address import parse
from hapticdb.transfer import copy_environment
from hapticdb.verdicts import Kind
from servers import Place, roles, url_as

MM = 1e-3
Found = list[tuple[object, ...]]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Four cubes in a row, each flush with the next."""
    return row_of_boxes(tmp_path / "row.db", 4)


def shifted(env: Environment, object_id: int, x: float) -> None:
    env.shift([object_id], (x, 0.0, 0.0))


def told(found: Clashes) -> set[tuple[int, int, str, str]]:
    return {(one.a, one.b, one.kind, one.status) for one in found.pairs}


def test_find_clashes_status_since_last_call(path: Path) -> None:
    with hapticdb.open(path) as env:
        first = find_clashes(env)
        assert told(first) == {(n, n + 1, "touching", "new") for n in (1, 2, 3)}
        assert (first.measured, first.kept, first.left, first.is_kept) == (3, 0, 0, True)
        again = find_clashes(env)
        assert {one.status for one in again.pairs} == {"same"}
        assert (again.measured, again.kept) == (0, 3)
        shifted(env, 1, 1.0 * MM)  # deeper into 2
        shifted(env, 4, 0.5)  # away from 3
        found = find_clashes(env)
        assert told(found) == {
            (1, 2, "overlapping", "changed"), (2, 3, "touching", "same"), (3, 4, "apart", "gone"),
        }  # fmt: skip
        assert found.measured == 1
        assert found._repr_html_().count("<tr>") == 2  # what is gone is not shown
        assert [(one.a, one.b) for one in found.of()] == [(1, 2)]
        assert (3, 4) not in {(one.a, one.b) for one in find_clashes(env).pairs}
        env.remove(1)
        gone = {one for one in find_clashes(env).pairs if one.status == "gone"}
        assert {(one.a_name, one.b_name) for one in gone} == {(None, "cube1")}


def test_find_clashes_of_and_against(path: Path) -> None:
    with hapticdb.open(path) as env:
        assert {one[:2] for one in find_clashes(env, of=["cube0"]).pairs} == {(1, 2)}
        assert find_clashes(env, of=["cube1"], against=["cube1"]).pairs == ()
        everything = find_clashes(env)
        assert {one[:2]: one.status for one in everything.pairs} == {
            (1, 2): "same", (2, 3): "new", (3, 4): "new",
        }  # fmt: skip
        found = find_clashes(env, of=["cube1"], against=["cube2", "cube3"])
        assert told(found) == {(2, 3, "touching", "same")}


def test_find_clashes_new_tolerance_measures_again(path: Path) -> None:
    with hapticdb.open(path) as env:
        shifted(env, 1, 0.2 * MM)
        assert [one.kind for one in find_clashes(env, of=[1]).pairs] == ["overlapping"]
        wider = find_clashes(env, of=[1], contact=0.5 * MM)
        assert [(one.kind, one.status) for one in wider.pairs] == [("touching", "changed")]
        assert wider.measured == 1


def test_accept_clash_until_shape_changes(path: Path) -> None:
    with hapticdb.open(path) as env:
        with pytest.raises(UsageError, match="run 'hapticdb clashes'"):
            accept_clash(env, [1], [2], "a press fit")
        shifted(env, 1, 1.0 * MM)
        assert len(find_clashes(env).of()) == 1
        assert len(accept_clash(env, ["cube1"], ["cube0"], "a press fit")) == 1
        shifted(env, 1, 1.0 * MM)
        (one,) = (one for one in find_clashes(env).pairs if one[:2] == (1, 2))
        assert (one.status, one.because) == ("accepted", "a press fit")
        assert find_clashes(env).of() == ()
        shifted(env, 1, -0.5)  # it goes and comes back
        find_clashes(env)
        shifted(env, 1, 0.5)
        assert find_clashes(env).of() == ()
        env.move(1, np.diag([1.0, 1.0, 1.1, 1.0]) @ env.object(1).transform)
        accepted = [one for one in find_clashes(env).pairs if one.status == "accepted"]
        assert [one[:2] for one in accepted] == [(1, 2)]  # placed otherwise, the same shape
        accept_clash(env, [1], [2], None)
        assert len(find_clashes(env).of()) == 1
        with pytest.raises(UsageError, match="empty reason"):
            accept_clash(env, [1], [2], " ")


def test_find_clashes_read_only_stores_nothing(path: Path) -> None:
    with hapticdb.open(path) as env, hapticdb.open(path, read_only=True) as reader:
        found = find_clashes(reader)
        assert not found.is_kept
        assert list(env.store.pairs()) == []
        find_clashes(env)
        assert find_clashes(reader).kept == 3


@pytest.mark.parametrize(("within", "contact", "seconds"), [(0.0, 1e-5, 1), (1e-5, 1e-3, 1),
    (np.inf, 1e-5, 1), (1e-3, np.nan, 1), (1e-3, 1e-5, 0.0)])  # fmt: skip
def test_find_clashes_bad_numbers(
    path: Path, within: float, contact: float, seconds: float
) -> None:
    with hapticdb.open(path) as env, pytest.raises(UsageError):
        find_clashes(env, within=within, contact=contact, seconds=seconds)


# -- stopped, killed, many at once -----------------------------------------------------------------


def findings(env: Environment) -> Found:
    """What the table says, without revisions."""
    return [(*row[:6], row.status) for row in env.store.pairs()]


def test_find_clashes_resumes_after_interrupt(path: Path) -> None:
    def stop(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with hapticdb.open(path) as env:
        with pytest.raises(KeyboardInterrupt):
            find_clashes(env, progress=stop)
        found = find_clashes(env)
        assert (found.measured, found.kept) == (1, 2)
        assert {one.status for one in found.pairs} == {"new"}
        assert {one.status for one in find_clashes(env).pairs} == {"same"}


def test_find_clashes_threads_same_pairs_and_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, found = row_of_boxes(tmp_path / "long.db", 9), []
    monkeypatch.setattr(search, "IN_FLIGHT", 1)
    with hapticdb.open(path) as env:
        for n in range(2, 10):
            shifted(env, n, (n % 3 - 1) * n * 0.01 * MM)  # no two pairs are placed alike
    with hapticdb.open(path, read_only=True) as env:
        for threads in (1, 4):
            monkeypatch.setattr(search, "THREADS", threads)
            found.append(find_clashes(env).pairs)
    assert found[0] == found[1]
    assert {one.kind for one in found[0]} == {Kind.APART, Kind.OVERLAPPING, Kind.TOUCHING}
    judged = iter(range(9))

    def raising(
        a: CollisionShape, b: CollisionShape, pose: Floats, within: float, contact: float
    ) -> PairResult:
        if next(judged) == 4:
            raise RuntimeError("the fifth")
        return classify_pair(a, b, pose, within, contact)

    monkeypatch.setattr(search, "classify_pair", raising)
    with hapticdb.open(path) as env:
        with pytest.raises(RuntimeError, match="the fifth"):
            find_clashes(env)
        assert 0 < len(list(env.store.pairs())) < 8


def test_find_clashes_time_limit_leaves_pairs_unknown(path: Path) -> None:
    with hapticdb.open(path) as env:
        found = find_clashes(env, seconds=1e-9)
        assert found.left == 3
        assert told(found) == {(n, n + 1, "not known", "not looked at") for n in (1, 2, 3)}
        assert len(found.of()) == 3
        assert find_clashes(env).left == 0


def random_edit(env: Environment, rng: np.random.Generator, removed: list[hapticdb.Object]) -> None:
    """Move, shift, remove or restore an object."""
    ids = [obj.id for obj in env.objects()]
    what = rng.integers(8)
    if removed and what == 0:
        env.restore(removed.pop())
    elif what == 1 and len(removed) < 5:
        removed.append(env.remove(int(rng.choice(ids))))
    else:
        pose = trimesh.transformations.random_rotation_matrix(rng.random(3))
        pose = np.eye(4) if what < 5 else pose
        pose[:3, 3] = np.round(rng.uniform(-0.3, 0.3, 3), 1 if what < 6 else 9)
        env.move(int(rng.choice(ids)), pose)


@pytest.mark.parametrize(
    ("n_edits", "n_queries"), [(60, 6), pytest.param(1000, 50, marks=pytest.mark.long)]
)
def test_find_clashes_incremental_equals_full_run(
    tmp_path: Path, n_edits: int, n_queries: int
) -> None:
    path, rng = row_of_boxes(tmp_path / "e.db", 20), np.random.default_rng(n_edits)
    removed: list[hapticdb.Object] = []
    with hapticdb.open(path) as env:
        for n in range(n_edits):
            random_edit(env, rng, removed)
            if (n + 1) % (n_edits // n_queries):
                continue
            find_clashes(env)
        kept = findings(env)
        assert full_findings(env) == [row[:6] for row in kept]
        assert len(kept) > 10
        assert len({row[2] for row in kept}) >= 3


def full_findings(env: Environment) -> Found:
    """What the table says after everything was measured anew, without statuses."""
    env.store.put_pairs([], [(row.a, row.b) for row in env.store.pairs()])
    find_clashes(env)
    return [row[:6] for row in findings(env)]


def test_find_clashes_reads_only_changed_neighbourhood(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hapticdb.open(path) as env:
        first = find_clashes(env)
        read: list[set[int]] = []
        objects = env.store.objects

        def noted(ids: Collection[int] | None = None) -> list[hapticdb.Object]:
            found = objects(ids)
            read.append({obj.id for obj in found})
            return found

        shifted(env, 4, 0.01 * MM)
        monkeypatch.setattr(env.store, "objects", noted)
        found = find_clashes(env)
        assert set.union(*read) == {3, 4}
        assert (found.measured, found.kept) == (1, 2)
        assert found.counts() == first.counts()
        assert [one[:4] for one in found.pairs] == [one[:4] for one in first.pairs]


def test_find_clashes_concurrent_edit_is_measured(path: Path) -> None:
    with hapticdb.open(path) as env, hapticdb.open(path) as other:
        late = PairRow(1, 4, Kind.TOUCHING, 0.0, 0.0, (0.0,) * 6, "same", 1, "of an older scene")
        find_clashes(env, progress=lambda *_: other.store.put_pairs([late]) and None)
        assert told(find_clashes(env)) == {
            (1, 2, "touching", "same"), (2, 3, "touching", "same"), (3, 4, "touching", "same"),
            (1, 4, "apart", "gone"),
        }  # fmt: skip
        kept = [row[:6] for row in findings(env)]
        assert len(kept) == 3
        assert full_findings(env) == kept


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM pair WHERE (a, b) = (2, 3)",
        "UPDATE pair SET kind = 'far', setting = 'of an older program' WHERE (a, b) = (2, 3)",
    ],
)
def test_find_clashes_repairs_rows_of_foreign_writers(path: Path, statement: str) -> None:
    with hapticdb.open(path) as env:
        find_clashes(env)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(statement)
    with hapticdb.open(path) as env:
        assert {one[:2] for one in find_clashes(env).pairs} == {(1, 2), (2, 3), (3, 4)}


def on_server(place: Place, path: Path) -> str:
    """The environment on a server."""
    url = place()
    copy_environment(path, url)
    return url


def test_find_clashes_two_concurrent_searches(place: Place, path: Path) -> None:
    url = on_server(place, path)
    errors: list[BaseException] = []

    def search() -> None:
        try:
            with hapticdb.open(url) as env:
                find_clashes(env, progress=lambda *_: time.sleep(0.01))
        except BaseException as error:  # noqa: BLE001 - told below
            errors.append(error)

    searching = [threading.Thread(target=search) for _ in range(2)]
    for one in searching:
        one.start()
    for one in searching:
        joined(one)
    assert not errors
    with hapticdb.open(url) as env, hapticdb.open(path) as alone:
        find_clashes(alone)
        assert findings(env) == findings(alone)
        assert {row.status for row in env.store.pairs()} == {"same"}


PAGE = Path(hapticdb.__file__).parents[2] / "docs" / "clashes.md"


def test_docs_pair_queries_same_on_each_engine(place: Place, path: Path) -> None:
    with hapticdb.open(path) as env:
        find_clashes(env)
        accept_clash(env, [1], [2], "meant so")
    answers: dict[str, list[list[tuple[object, ...]]]] = {"file": [], "server": []}
    url = on_server(place, path)
    with hapticdb.open(url) as env:
        find_clashes(env)
        accept_clash(env, [1], [2], "meant so")
    address = parse(url)
    questions = re.findall(r"^```sql\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(questions) == 3
    with closing(sqlite3.connect(path)) as plain, psycopg.connect(address.conninfo) as server:
        server.execute(sql.SQL("SET search_path = {}").format(sql.Identifier(address.environment)))
        for question in questions:
            answers["file"].append(sorted(plain.execute(question).fetchall()))
            answers["server"].append(sorted(server.execute(question.encode()).fetchall()))
    assert answers["file"] == answers["server"]
    assert answers["file"][2] == [("cube0", "cube1", "meant so", True)]


KILLED = """
import os, signal, sys
import hapticdb
from hapticdb.clashes import search as run
run.SECONDS_BETWEEN = -1.0  # each pair is written at once
def progress(done, total):
    if done == 2:
        os.kill(os.getpid(), signal.SIGKILL)
with hapticdb.open(sys.argv[1]) as env:
    hapticdb.find_clashes(env, progress=progress)
"""


def test_find_clashes_after_sigkill_continues(place: Place, path: Path) -> None:
    url = on_server(place, path)
    assert finished([sys.executable, "-c", KILLED, url]).returncode == -signal.SIGKILL
    with hapticdb.open(url) as env, hapticdb.open(path) as alone:
        found = find_clashes(env)
        assert (found.measured, found.kept) == (1, 2)
        assert {one.status for one in found.pairs} == {"new"}
        find_clashes(alone)
        assert findings(env) == findings(alone)


def test_find_clashes_roles_viewer_and_editor(
    place: Place, path: Path, admin: psycopg.Connection
) -> None:
    url = on_server(place, path)
    role = f"clashes_{os.getpid()}"
    their_url = url_as(url, role)
    with roles(admin, role):
        grant(url, role, "toucher")
        with hapticdb.open(their_url) as env:
            found = find_clashes(env)
            assert (len(found.pairs), found.is_kept) == (3, False)
        grant(url, role, "editor")
        with hapticdb.open(their_url) as env:
            assert find_clashes(env).is_kept
        grant(url, role, "viewer")
        with hapticdb.open(their_url, read_only=True) as env:
            assert find_clashes(env).kept == 3
