"""Reads from a standby: which server answers, how old the answer is, and who may write."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import psycopg
import pytest

import hapticdb
from children import joined, until
from hapticdb import Grid
from hapticdb.store.connect import create_store, exists, grant, open_store
from hapticdb.store.engines import MayLag
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.standby import following
from hapticdb.store.postgres.standby.aiming import aimed, at_primary
from hapticdb.store.postgres.standby.asking import PrimaryQuestions, ToldRevision
from hapticdb.store.postgres.store import PostgresStore
from hapticdb.testing import is_noticed, write_voxels
from standbys import Pair, pair  # noqa: F401 - a fixture

GRID = Grid(0.005, (0, 0, 0), 7)
VOXEL = np.array([[1, 2, 3]])
EVERYWHERE = np.array([0]), np.array([2**62])
numbers = itertools.count()


@pytest.fixture
def name(pair: Pair) -> Iterator[str]:
    """Name of an environment with one object, which the standby has, too."""
    made = f"test_{next(numbers)}"
    create_store(pair.at_primary(made), GRID).close()
    write(pair, made)
    pair.await_replay()
    yield made
    for server in pair.folder.iterdir():
        if server.name != "primary":
            with contextlib.suppress(psycopg.Error):
                pair.resume(PrivateServer.at(server, pair.primary.binaries))


def write(pair: Pair, name: str) -> None:
    with contextlib.closing(PostgresStore.open(pair.at_primary(name))) as store:
        write_voxels(store, VOXEL, f"{next(numbers)}")


def opened(url: str) -> contextlib.closing[PostgresStore]:
    return contextlib.closing(PostgresStore.open(url, read_only=True))


def is_standby(store: PostgresStore) -> bool:
    return store.connection.rows("SELECT pg_is_in_recovery()") == [(True,)]


# -- which server ---------------------------------------------------------------------------------


def test_a_reader_reads_from_the_standby_what_the_primary_has(pair: Pair, name: str) -> None:
    with opened(pair.url(name)) as here, opened(pair.at_primary(name)) as there:
        assert is_standby(here)
        assert here.connection.is_standby
        assert not there.connection.is_standby
        assert here.revision() == there.revision() == 1
        for found, expected in (
            (here.scan(*EVERYWHERE), there.scan(*EVERYWHERE)),
            (here.lookup(GRID.encode(VOXEL) >> 9), there.lookup(GRID.encode(VOXEL) >> 9)),
        ):
            assert len(found) == 1
            np.testing.assert_array_equal(found.keys, expected.keys)
            np.testing.assert_array_equal(found.occupancy, expected.occupancy)
        assert [obj.name for obj in here.objects()] == [obj.name for obj in there.objects()]
        with here.snapshot():
            assert len(list(here.changes(0))) == 1
        here.watch()
        for _ in range(3):
            write(pair, name)
            assert is_noticed(here)
        assert here.revision() == 4


def test_a_writer_goes_to_the_primary(pair: Pair, name: str) -> None:
    for attrs in ("prefer-standby", "any", "primary", "read-write"):
        url = pair.url(name, pair.standby, pair.primary, attrs=attrs)
        with contextlib.closing(PostgresStore.open(url)) as store:
            assert not is_standby(store)
            write_voxels(store, VOXEL, attrs)
    with opened(pair.at_primary(name)) as store:
        assert store.revision() == 5


def test_a_writer_whom_the_url_sends_to_a_standby_is_told_in_one_line(
    pair: Pair, name: str
) -> None:
    for attrs in ("standby", "read-only"):
        with pytest.raises(hapticdb.ReadOnlyError, match=f"target_session_attrs={attrs}") as told:
            PostgresStore.open(pair.url(name, attrs=attrs))
        assert "\n" not in str(told.value)
    alone = pair.url(name, pair.standby)
    with pytest.raises(hapticdb.ReadOnlyError, match="is a standby: it can only be read") as told:
        PostgresStore.open(alone)
    assert "\n" not in str(told.value)
    with pytest.raises(hapticdb.ReadOnlyError, match="is a standby: it can only be read"):
        grant(alone, "pg_monitor", "viewer")


def test_whether_an_environment_is_there_is_asked_of_the_primary(pair: Pair) -> None:
    name = f"test_{next(numbers)}"
    url = pair.url(name)
    with pair.paused():
        assert not exists(url)
        create_store(pair.at_primary(name), GRID).close()
        assert exists(url)
        with pytest.raises(hapticdb.EnvironmentNotFoundError):
            open_store(url, read_only=True)
    pair.await_replay()
    open_store(url, read_only=True).close()


def test_an_environment_is_made_on_the_primary_where_the_url_prefers_a_standby(
    pair: Pair,
) -> None:
    url = pair.url(f"test_{next(numbers)}")
    with hapticdb.create(url, GRID) as env:
        write_voxels(env.store, VOXEL, "first")
        assert env.store.revision() == 1


def test_one_host_and_other_values_are_left_as_they_are() -> None:
    for conninfo in (
        "postgresql://h/x",
        "postgresql://h1,h2/x?target_session_attrs=read-write",
        "postgresql://h/x?nonsense=1",
    ):
        assert aimed(conninfo, conninfo, read_only=False) == conninfo
    for conninfo in ("postgresql://h1,h2/x", "postgresql:///x?host=/a,/b"):
        assert "target_session_attrs=primary" in aimed(conninfo, "", read_only=False)
        assert aimed(conninfo, "", read_only=True) == conninfo


def test_the_primary_is_asked_with_a_limit_beside_the_urls_own_options() -> None:
    found = at_primary(
        "postgresql://h1,h2/x?target_session_attrs=prefer-standby&options=-cjit%3Don"
    )
    assert "target_session_attrs=primary" in found
    assert "-cjit=on -cstatement_timeout=1000" in found


# -- how old the answers are ----------------------------------------------------------------------


def test_on_the_primary_each_answer_is_the_newest(pair: Pair, name: str) -> None:
    with opened(pair.at_primary(name)) as store:
        assert isinstance(store, MayLag)
        store.begin_proofs()
        assert store.newest_at(store.revision()) is None
        assert store.lag() is None


def test_a_standby_is_proved_up_to_date_again_and_again(pair: Pair, name: str) -> None:
    with opened(pair.url(name)) as store:
        store.begin_proofs()
        for _ in range(2):
            began = time.monotonic_ns()
            until(lambda t=began: (store.newest_at(store.revision()) or 0) > t)  # type: ignore[misc]
            found = store.newest_at(store.revision())
            assert found is not None
            assert found < time.monotonic_ns()
            write(pair, name)


def test_a_standby_that_replays_nothing_is_proved_up_to_the_first_write_alone(
    pair: Pair, name: str
) -> None:
    with opened(pair.url(name)) as store:
        store.begin_proofs()
        with pair.paused():
            began = time.monotonic_ns()
            # nothing is written, so it is up to date all the same
            until(lambda: (store.newest_at(store.revision()) or 0) > began)
            write(pair, name)
            committed = time.monotonic_ns()
            time.sleep(0.5)
            assert store.revision() == 1
            found = store.newest_at(1)
            assert found is not None
            assert found < committed
        until(lambda: store.revision() == 2)
        until(lambda: (store.newest_at(2) or 0) > committed)


def test_no_write_that_is_committed_before_a_proved_instant_is_missing(
    pair: Pair, name: str
) -> None:
    """Writes without a pause: what is proved is compared with the time of each commit."""
    commits: list[tuple[int, int]] = []
    is_over = threading.Event()

    def write_on() -> None:
        with contextlib.closing(PostgresStore.open(pair.at_primary(name))) as store:
            while not is_over.is_set():
                write_voxels(store, VOXEL, f"{next(numbers)}")
                commits.append((store.revision(), time.monotonic_ns()))

    writer = threading.Thread(target=write_on, daemon=True)
    with opened(pair.url(name)) as store:
        store.begin_proofs()
        writer.start()
        claims: set[tuple[int, int]] = set()
        ends = time.monotonic() + 1.5
        while time.monotonic() < ends:
            revision = store.revision()
            claims.add((revision, store.newest_at(revision) or 0))
        is_over.set()
        joined(writer)
    assert len({at for _, at in claims}) > 5
    assert len(commits) > 50
    for revision, at in claims:
        before = [number for number, committed in commits if committed < at]
        assert max(before, default=0) <= revision


def test_a_standby_that_is_behind_is_not_begun_with(
    pair: Pair, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "CATCH_UP_S", 0.1)
    with opened(pair.url(name)) as store:
        with pair.paused():
            write(pair, name)
            with pytest.raises(hapticdb.StaleError, match="revision 1, its primary has 2") as told:
                store.begin_proofs()
            assert "\n" not in str(told.value)
        pair.await_replay()
        store.begin_proofs()


def test_a_standby_alone_proves_nothing_and_says_so(pair: Pair, name: str) -> None:
    with opened(pair.url(name, pair.standby)) as store:
        with pytest.raises(hapticdb.StaleError, match="name the primary in the URL") as told:
            store.begin_proofs()
        assert "\n" not in str(told.value)
        assert store.newest_at(store.revision()) == 0
        store.watch()
        write(pair, name)
        assert is_noticed(store)  # it can be read as before
        assert store.revision() == 2


def test_after_a_loss_a_standby_that_is_further_behind_is_refused(pair: Pair, name: str) -> None:
    other = pair.add(f"other_{next(numbers)}")
    url = pair.url(name, pair.standby, other, pair.primary)
    try:
        pair.pause(other)
        write(pair, name)
        pair.await_replay()
        with opened(url) as store:
            assert store.revision() == 2
            store.begin_proofs()
            store.connection.driver.close()
            pair.standby.stop()
            for ask in (store.revision, lambda: store.scan(*EVERYWHERE), store.objects):
                with pytest.raises(hapticdb.StaleError, match="revision 1, and 2 was read") as told:
                    ask()
                assert "\n" not in str(told.value)
            pair.resume(other)
            until(lambda: _revision_of(store) == 2)
            assert len(store.scan(*EVERYWHERE)) == 2
    finally:
        pair.standby.start()
        other.stop()


def _revision_of(store: PostgresStore) -> int:
    with contextlib.suppress(hapticdb.StaleError):
        return store.revision()
    return -1


def test_where_no_standby_answers_the_primary_is_read_and_proves_itself(
    pair: Pair, name: str
) -> None:
    with opened(pair.url(name)) as store:
        store.begin_proofs()
        until(lambda: (store.newest_at(store.revision()) or 0) > 0)
        pair.standby.stop()
        try:
            assert store.revision() == 1
            assert not store.connection.is_standby
            assert store.newest_at(1) == 0  # answers of two servers since the last call
            assert store.newest_at(1) is None
        finally:
            pair.standby.start()


@pytest.mark.long
def test_a_primary_that_is_lost_proves_nothing_until_it_is_back(pair: Pair, name: str) -> None:
    with opened(pair.url(name)) as store:
        store.begin_proofs()
        pair.primary.kill()
        try:
            lost = time.monotonic_ns()
            time.sleep(0.5)
            found = store.newest_at(store.revision())  # it is read as before
            assert found is not None
            assert found < lost
        finally:
            pair.primary.start()
        until(lambda: (store.newest_at(store.revision()) or 0) > lost)
    pair.await_replay()


@pytest.mark.long
def test_a_standby_that_is_promoted_is_read_and_written_as_the_primary(
    pair: Pair, name: str
) -> None:
    other = pair.add(f"other_{next(numbers)}")
    url = pair.url(name, pair.primary, other)
    with opened(url) as store:
        assert store.connection.is_standby
        pair.primary.stop()
        try:
            with psycopg.connect(other.conninfo(), autocommit=True) as admin:
                admin.execute("SELECT pg_promote()")
            until(lambda: store.revision() == 1 and not store.connection.is_standby)
            store.newest_at(1)
            assert store.newest_at(1) is None
            with contextlib.closing(PostgresStore.open(url)) as writer:
                write_voxels(writer, VOXEL, "after")
            assert store.revision() == 2
        finally:
            other.stop()
            pair.primary.start()
    pair.await_replay()


def test_questions_keep_what_is_still_ahead_of_the_standby(
    pair: Pair, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PrimaryQuestions, "_follow", lambda _: None)
    with opened(pair.at_primary(name)) as store:
        here = store.connection
        questions = PrimaryQuestions(here.address, here.conninfo, store.identity)
        questions._answers.extend(ToldRevision(10 * n, n) for n in range(1, 6))
        assert [questions.newest_at(n) for n in (0, 1, 1, 3, 3, 9)] == [0, 10, 10, 30, 30, 50]


class Slow:
    """Passes a question on, and notes when it was asked."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        self.asked_at = 0

    def execute(self, text: str) -> "psycopg.Cursor[tuple[Any, ...]]":
        self.asked_at = time.monotonic_ns()
        return self._connection.execute(text)


def test_an_answer_counts_from_before_the_question(
    pair: Pair, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PrimaryQuestions, "_follow", lambda _: None)
    with opened(pair.at_primary(name)) as store:
        here = store.connection
        questions = PrimaryQuestions(here.address, here.conninfo, store.identity)
        slow: Any = Slow(here)
        questions._ask(slow)
        assert 0 < questions.newest_at(1) <= slow.asked_at


def test_questions_to_a_primary_that_has_lost_commits_forget_what_was_told(
    pair: Pair, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PrimaryQuestions, "_follow", lambda _: None)
    with opened(pair.at_primary(name)) as store:
        here = store.connection
        questions = PrimaryQuestions(here.address, here.conninfo, store.identity)
        questions._answers.append(ToldRevision(5, 7))
        questions._newest = 7
        questions._ask(here)
        assert [answer.revision for answer in questions._answers] == [1]
        assert questions.first(0.0) == 1
        other = PrimaryQuestions(here.address, here.conninfo, -1)
        with pytest.raises(hapticdb.HapticDBError, match="another environment"):
            other._ask(here)


# -- how far behind -------------------------------------------------------------------------------


def test_the_lag_is_told_in_bytes_seconds_and_writes(
    pair: Pair, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(pair.url(name)) as store:
        lag = store.lag()
        assert lag is not None
        assert lag[1:] == (0, 0.0, 0, None)
        monkeypatch.setattr(following, "CATCH_UP_S", 0.0)
        with pair.paused():
            before = time.time()
            for _ in range(3):
                write(pair, name)
            time.sleep(0.2)
            lag = store.lag()
            assert lag is not None
            assert lag.bytes is not None
            assert lag.seconds is not None
            assert lag.bytes > 100
            assert lag.seconds >= 0.2
            assert lag.writes == 3
            assert lag.unknown is None
        assert time.time() > before


def test_without_a_primary_the_lag_is_not_known(pair: Pair, name: str) -> None:
    with opened(pair.url(name, pair.standby)) as store:
        lag = store.lag()
        assert lag is not None
        assert "/" in lag.replayed
        assert (lag.bytes, lag.seconds, lag.writes) == (None, None, None)
        assert lag.unknown is not None
        assert "\n" not in lag.unknown
