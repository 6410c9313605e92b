"""Borders between shards move while others read and write; what is interrupted is taken up."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import contextlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from psycopg import sql

import hapticdb
from children import PATIENCE
from command_line import Run, refused, run  # noqa: F401 - a fixture
from hapticdb import Grid, PointShell
from hapticdb.errors import AccessError, BusyError, OutdatedError, ShardAwayError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.query.frame import Strategy
from hapticdb.query.grouping import object_ranges
from hapticdb.store.base import CELL_SHIFT, Keys, Layout, Rows, row_shift
from hapticdb.store.postgres.connecting import connection
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards.borders import carrying, moves, rebalancing
from hapticdb.store.postgres.shards.borders.moves import Move, all_moves, borders_after, part_of
from hapticdb.store.postgres.shards.pieces import even_borders
from hapticdb.store.postgres.shards.statistics import joined_histograms
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.store.sharding import Rebalanced, RebalanceProgress
from hapticdb.testing.scenes import (
    blob,
    covering,
    everything,
    voxel_object,
    with_distances,
    write_voxels,
)
from servers import Place
from sharded import ShardedServers

N_CELLS = 40
GRID = Grid(0.01, (0.0, 0.0, 0.0), 8)
"""512 cells; the scene is in the first 64 of them, which are all on the first shard."""
N_OBJECTS = 24
TABLES: dict[Layout, tuple[str, ...]] = {"voxel": ("voxel",), "brick": ("brick", "band")}


# --- the plan -----------------------------------------------------------------------------------


def borders(n_shards: int) -> st.SearchStrategy[Keys]:
    """First voxel keys of shards, on cells; some shards are empty."""
    inner = st.lists(st.integers(0, N_CELLS), min_size=n_shards - 1, max_size=n_shards - 1)
    return inner.map(lambda some: np.array([0, *sorted(some)], dtype=np.int64) << CELL_SHIFT)


BOTH = st.integers(1, 7).flatmap(lambda n: st.tuples(borders(n), borders(n)))


def owners(firsts: Keys) -> Keys:
    """The shard of each cell (N_CELLS,)."""
    return np.searchsorted(firsts, np.arange(N_CELLS) << CELL_SHIFT, "right") - 1


def cells_of(move: Move) -> slice:
    return slice(move.low >> CELL_SHIFT, move.high >> CELL_SHIFT)


@given(BOTH, st.data())
def test_each_cell_goes_at_most_once_and_straight_to_its_shard(
    both: tuple[Keys, Keys], data: st.DataObject
) -> None:
    now, wanted = both
    holder, aim = owners(now), owners(wanted)
    n_moved = np.zeros(N_CELLS, np.int64)
    while (move := moves.next_move(now, wanted)) is not None:
        assert move.low < move.high
        key = data.draw(st.none() | st.integers(move.low, move.high - 1))
        batch = part_of(move, key)
        assert move.low <= batch.low < batch.high <= move.high
        assert key is None or batch.low <= key < batch.high
        some = cells_of(batch)
        assert (holder[some] == move.source).all()  # it has what it gives away
        assert (aim[some] == move.target).all()
        holder[some] = move.target
        n_moved[some] += 1
        now = borders_after(now, batch)
        assert (np.diff(now) >= 0).all()
        assert now[0] == 0
        assert (owners(now) == holder).all()
    assert (now == wanted).all()
    assert (n_moved == (owners(both[0]) != aim)).all()


@given(BOTH)
def test_all_moves_are_those_of_whole_batches(both: tuple[Keys, Keys]) -> None:
    now, wanted = both
    for move in all_moves(now, wanted):
        now = borders_after(now, move)
    assert (now == wanted).all()


def test_rows_pass_over_a_shard_that_keeps_none_of_them() -> None:
    now = np.array([0, 30, 30], dtype=np.int64) << CELL_SHIFT
    wanted = np.array([0, 10, 20], dtype=np.int64) << CELL_SHIFT
    found = [(m.source, m.target, m.low >> 15, m.high >> 15) for m in all_moves(now, wanted)]
    assert found == [(0, 2, 20, 30), (0, 1, 10, 20)]


@given(
    st.lists(
        arrays.arrays(np.int64, 10_001, elements=st.integers(0, 2**40), fill=st.integers(0, 99)),
        min_size=1,
        max_size=3,
    )
)
def test_joined_histograms_ascend_whatever_old_statistics_say(some: list[Keys]) -> None:
    """Statistics of a shard can be those of rows that have moved away."""
    bounds, n_rows = joined_histograms([np.sort(one) for one in some], [100_000] * len(some))
    assert (np.diff(bounds) >= 0).all()
    assert n_rows == 100_000 * len(some)


# --- rows ---------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carrying, "BATCH_ROWS", {"voxel": 500, "brick": 20, "band": 60})
    monkeypatch.setattr(rebalancing, "DELETED_ROWS", 100)
    monkeypatch.setattr(rebalancing, "PAUSE_SECONDS", 0.0)


def shape(seed: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Voxels of an object somewhere in the first 64 cells."""
    rng = np.random.default_rng(seed)
    return blob(seed, tuple(rng.integers(10, 118, 3).tolist()))


@contextlib.contextmanager
def made(
    url: str, layout: Layout = "brick", *, distances: bool = False, grid: Grid = GRID
) -> Iterator[ShardedStore]:
    """An environment of `N_OBJECTS` objects, of which some were replaced and some removed."""
    with contextlib.closing(ShardedStore.create(url, grid, layout, distances=distances)) as store:
        for seed in range(N_OBJECTS):
            if distances:
                rows = with_distances(shape(seed), grid, layout, seed)
                store.add(voxel_object(grid, shape(seed), str(seed)), rows)
            else:
                write_voxels(store, shape(seed), str(seed))
        store.remove(3, covering(store))
        replace(store, 5, shape(1000))
        yield store


def replace(store: ShardedStore, object_id: int, voxels: Keys) -> None:
    record = voxel_object(store.grid, voxels, str(object_id))
    kept = {"id": object_id, "revision": store.object(object_id).revision}
    rows = rows_of_voxels(voxels, store.grid, store.layout)
    store.replace(record.__class__(**{**vars(record), **kept}), rows, covering(store))


Contents = dict[str, tuple[list[Any], ...]]


def listed(rows: Rows) -> tuple[list[Any], ...]:
    band = [] if rows.distances is None else [rows.distances.data.tobytes()]
    return rows.keys.tolist(), rows.ids.tolist(), [rows.occupancy.tobytes()], band


def contents(store: ShardedStore) -> Contents:
    """All rows, by every way to read them."""
    rows = everything(store)
    distinct = np.unique(rows.keys)
    found = {
        "scan": listed(rows),
        "partly": listed(store.scan_partly(np.array([0]), np.array([2**62])).rows),
        "lookup": listed(store.lookup(distinct)),
        "each": listed(store.lookup_each(distinct[::25])),
        "after": listed(store.checker().rows_after(-1, 0, 1 << 20)),
        "few after": listed(store.checker().rows_after(int(distinct[7]), 1, 50)),
        "count": ([store.count(np.array([0]), np.array([2**62]))],),
    }
    for obj in store.objects():
        ends = object_ranges(store.grid, store.layout, obj)
        found[f"object {obj.id}"] = listed(store.rows_of(obj.id, ends.lows, ends.highs))
    if store.wants_distances:
        found["band"] = listed(store.scan(np.array([0]), np.array([2**62]), distances=True))
        found["band of 1"] = listed(
            store.rows_of(1, np.array([0]), np.array([2**62]), distances=True)
        )
    return found


def on_shards(servers: ShardedServers, store: ShardedStore, text: str) -> list[Any]:
    """Answers of each shard's server to one statement."""
    found = []
    for server in servers.shards:
        with psycopg.connect(server.conninfo(), autocommit=True) as asked:
            name = sql.Identifier(store.name)
            asked.execute(sql.SQL("SET search_path = {}").format(name))
            found.append(asked.execute(text.encode()).fetchall())  # type: ignore[arg-type]
    return found


def row_borders(store: ShardedStore) -> list[int]:
    """First row key of each shard, and one above all keys."""
    ((firsts,),) = store.connection.rows("SELECT array_agg(first_key ORDER BY number) FROM shard")
    return [first >> row_shift(store.layout) for first in firsts] + [2**62]


def assert_only_own_rows(servers: ShardedServers, store: ShardedStore) -> None:
    """Each shard holds rows inside its borders only, and lists their versions."""
    ends = row_borders(store)
    for table in TABLES[store.layout]:
        for at, keys in enumerate(on_shards(servers, store, f"SELECT z_val FROM {table}")):
            assert all(ends[at] <= key < ends[at + 1] for (key,) in keys), (table, at)
        unlisted = f"SELECT id, version FROM {table} EXCEPT SELECT id, version FROM written"
        assert on_shards(servers, store, unlisted) == [[], [], []]


KINDS = [
    ("brick", "z", True),
    ("brick", "hilbert", False),
    ("voxel", "z", False),
    ("voxel", "lexicographic", False),
]


@pytest.mark.parametrize(("layout", "curve", "distances"), KINDS)
def test_rows_are_the_same_and_spread_evenly(
    sharded_place: Place,
    sharded_servers: ShardedServers,
    layout: Layout,
    curve: Any,  # noqa: ANN401 - the name of a curve
    distances: bool,
) -> None:
    grid = Grid(GRID.voxel_size, GRID.origin, GRID.bits, curve)
    with made(sharded_place(), layout, distances=distances, grid=grid) as store:
        before = contents(store)
        told: list[RebalanceProgress] = []
        report = store.rebalance(told.append)
        assert contents(store) == before
        assert_only_own_rows(sharded_servers, store)
        n_rows = len(before["scan"][0])
        assert sum(report.rows_before) == sum(report.rows_after) == n_rows
        assert report.environment == store.url
        assert [name.split()[:2] for name in report.shards] == [
            ["shard", str(n)] for n in (1, 2, 3)
        ]
        # a cell is never on two shards: a border is off by less than one cell's rows
        cells = np.array(before["scan"][0]) >> (CELL_SHIFT - row_shift(layout))
        most = np.unique(cells, return_counts=True)[1].max()
        assert max(abs(n - n_rows / 3) for n in report.rows_after) <= 2 * most
        assert [one.rows_done for one in told] == sorted({one.rows_done for one in told})
        assert told[-1] == (report.moved_rows, report.moved_rows)
        assert len(told) > 3
        assert report.moved_bytes > 8 * report.moved_rows
        again = store.rebalance()
        assert (again.moved_rows, again.rows_after) == (0, report.rows_after)
        assert contents(store) == before


def test_borders_move_both_ways_and_back(
    sharded_place: Place, sharded_servers: ShardedServers
) -> None:
    with made(sharded_place()) as store:
        before = contents(store)
        shards = store._rebalancer
        number = shards._begun()
        for cells in ((0, 20, 40), (0, 0, 0), (0, 64, 64), (0, 3, 60), (0, 171, 342)):
            wanted = np.array(cells, dtype=np.int64) << CELL_SHIFT
            while shards._moved(wanted, number) is not None:
                assert everything(store).keys.tolist() == before["scan"][0]
            shards._deleted(number)
            assert contents(store) == before
            assert_only_own_rows(sharded_servers, store)
        (counts,) = on_shards(sharded_servers, store, "SELECT writes FROM mark")[1]
        ((published,),) = store.connection.rows("SELECT writes FROM shard WHERE number = 2")
        assert counts[0] == published  # `check` compares them
        assert not list(store.checker().findings())


def test_an_environment_without_rows_is_balanced(sharded_place: Place) -> None:
    with contextlib.closing(ShardedStore.create(sharded_place(), GRID)) as store:
        report = store.rebalance()
        assert (report.moved_rows, report.rows_after) == (0, (0, 0, 0))
        ((firsts,),) = store.connection.rows("SELECT array_agg(first_key) FROM shard")
        assert firsts == even_borders(GRID, 3).tolist()


# --- interrupted --------------------------------------------------------------------------------


class Killed(BaseException):
    """Ends a rebalance anywhere, as Ctrl-C or a kill would."""


def killing(after: int, *, is_done: bool) -> Callable[[Any], Any]:
    """Wrap a function so that a call ends in `Killed`, before or after it has done its work."""
    left = after

    def wrap(function: Any) -> Any:  # noqa: ANN401 - any function
        def called(*args: Any, **options: Any) -> Any:  # noqa: ANN401
            nonlocal left
            left -= 1
            if left < 0 and not is_done:
                raise Killed
            result = function(*args, **options)
            if left < 0:
                raise Killed
            return result

        return called

    return wrap


STEPS = [
    (rebalancing.Rebalancer, "_begun", 0, True),  # the rebalance has its number
    (rebalancing.Rebalancer, "_planned", 0, True),
    (rebalancing.Rebalancer, "_carried", 0, False),  # the write lock is held
    (carrying.Carrier, "_list", 1, False),  # older copies are deleted
    (carrying, "_copied", 2, False),  # versions are listed
    (carrying, "_copied", 3, False),  # the rows are copied, the distances are not
    (carrying, "_copied", 3, True),
    (carrying.Carrier, "carry", 1, True),  # the new shard has committed
    (rebalancing, "borders_after", 2, False),
    (rebalancing.Rebalancer, "_moved", 2, True),  # the border has moved
    (rebalancing.Rebalancer, "_deleted", 0, False),  # all borders have
    (rebalancing.Rebalancer, "_wait_for_snapshots", 0, True),
    (rebalancing.Rebalancer, "_delete", 0, True),  # some rows are deleted
    (rebalancing.IndexesOnShards, "vacuum", 0, False),
]


QUICK = {"_moved", "_delete"}
"""Steps of the quick suite."""


@pytest.mark.parametrize(
    ("owner", "name", "after", "is_done"),
    [
        pytest.param(
            *step,
            id=f"{step[1]}-{step[2]}-{step[3]}",
            marks=[] if step[1] in QUICK else [pytest.mark.long],
        )
        for step in STEPS
    ],
)
def test_a_rebalance_killed_at_any_step_is_taken_up(
    sharded_place: Place,
    sharded_servers: ShardedServers,
    owner: Any,  # noqa: ANN401 - a class or a module
    name: str,
    after: int,
    is_done: bool,
) -> None:
    url = sharded_place()
    with made(url, distances=True) as store, pytest.MonkeyPatch.context() as patch:
        before = contents(store)
        patch.setattr(owner, name, killing(after, is_done=is_done)(getattr(owner, name)))
        with pytest.raises(Killed):
            store.rebalance()
        patch.undo()
        small = {"voxel": 500, "brick": 20, "band": 60}
        patch.setattr(carrying, "BATCH_ROWS", small)
        with contextlib.closing(ShardedStore.open(url)) as another:
            assert contents(another) == before
            replace(another, 6, shape(2000))  # a write beside what was left
            replace(another, 6, shape(5))
            assert everything(another).keys.tolist() == before["scan"][0]
            written = contents(another)
            report = another.rebalance()
            assert contents(another) == written
            assert max(report.rows_after) < sum(report.rows_after) / 2
            assert_only_own_rows(sharded_servers, another)
            another.sweep()
            assert contents(another) == written
            assert not list(another.checker().findings())
        assert contents(store) == written  # the one that was killed lives


@pytest.mark.parametrize("n_pieces", [1, 2])
def test_a_rebalance_killed_within_a_copy_can_go_on(
    sharded_place: Place, monkeypatch: pytest.MonkeyPatch, n_pieces: int
) -> None:
    with made(sharded_place(), distances=True) as store:
        before = contents(store)
        with pytest.MonkeyPatch.context() as patch:
            sent, n_sent = carrying._sent, 0

            def cut_off(*args: Any) -> Iterator[bytes]:
                nonlocal n_sent
                for piece in sent(*args):
                    yield piece
                    n_sent += len(piece) > 100  # not the header alone
                    if n_sent >= n_pieces:
                        raise Killed

            patch.setattr(carrying, "_sent", cut_off)
            with pytest.raises(Killed):
                store.rebalance()
        assert contents(store) == before  # by the same connections
        monkeypatch.setattr(rebalancing, "PAUSE_SECONDS", 0.0)
        assert store.rebalance().moved_rows
        assert contents(store) == before


def test_older_copies_at_the_new_shard_are_replaced(
    sharded_place: Place, sharded_servers: ShardedServers
) -> None:
    """An object is replaced after its old rows were copied and before the border moved."""
    with made(sharded_place()) as store:
        with pytest.MonkeyPatch.context() as patch:
            end = killing(1, is_done=True)  # the first one moves a range without rows
            patch.setattr(carrying.Carrier, "carry", end(carrying.Carrier.carry))
            patch.setattr(carrying, "BATCH_ROWS", {"voxel": 10**9, "brick": 10**9, "band": 10**9})
            with pytest.raises(Killed):
                store.rebalance()
        stale = sum(
            n for ((n,),) in on_shards(sharded_servers, store, "SELECT count(*) FROM brick")
        )
        assert stale > len(everything(store))
        for object_id in (1, 2, 4):
            replace(store, object_id, shape(100 + object_id))
        before = contents(store)
        store.rebalance()
        assert contents(store) == before
        store.sweep()
        held = sum(n for ((n,),) in on_shards(sharded_servers, store, "SELECT count(*) FROM brick"))
        assert held == len(everything(store))


@pytest.mark.parametrize("kind", ["array", "points", "maxgap", "cbgroup", "auto"])
def test_a_frame_feels_the_same(sharded_place: Place, kind: Strategy) -> None:
    url = sharded_place()
    rng = np.random.default_rng(1)
    shell = PointShell(
        points=(shape(0) + 0.5) * GRID.voxel_size,
        normals=np.tile([0.0, 0.0, 1.0], (len(shape(0)), 1)),
        center=np.zeros(3),
        is_closed=True,
    )
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1:, :3, 3] = rng.uniform(-0.03, 0.03, (3, 3))
    with made(url) as store, hapticdb.open(url, read_only=True) as env:
        before = [env.touch(shell, pose, kind, law="plane") for pose in poses]
        store.rebalance()
        for was, pose in zip(before, poses, strict=True):
            now = env.touch(shell, pose, kind, law="plane")
            assert len(now.hits)
            assert (now.hits == was.hits).all()
            assert (now.force == was.force).all()
            assert (now.torque == was.torque).all()


# --- the verb -----------------------------------------------------------------------------------


def test_the_verb_says_what_has_moved(run: Run, sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store:
        code, out, err = run("rebalance", url)
        assert (code, err) == (0, "")
        assert re.fullmatch(r"\S+: [\d,]+ rows moved \([\d.]+ MB\); rows of the servers .*\n", out)
        code, out, _ = run("rebalance", url)
        assert (code, "balanced already" in out) == (0, True)
        code, out, _ = run("rebalance", url, "--json")
        found = json.loads(out)
        assert list(found) == list(Rebalanced._fields)
        assert sum(found["rows_after"]) == len(everything(store))


def test_an_environment_on_one_server_has_nothing_to_rebalance(
    run: Run, place: Place, tmp_path: Path
) -> None:
    for url in (place(), str(tmp_path / "a.db")):
        hapticdb.create(url, GRID).close()
        refused(run("rebalance", url), "has one server: nothing to rebalance")


# --- others beside ------------------------------------------------------------------------------


def test_readers_and_a_writer_beside_it_see_whole_objects(sharded_place: Place) -> None:
    url = sharded_place()
    troubles: list[BaseException] = []
    ending = threading.Event()
    n_read = [0, 0, 0]
    n_outdated = [0, 0, 0]
    shapes = [shape(1000), shape(3000), shape(4000)]
    with made(url) as store:
        before = everything(store)
        others = {i: before.keys[before.ids == i].tolist() for i in np.unique(before.ids).tolist()}
        known = [rows_of_voxels(s, GRID, "brick").keys.tolist() for s in shapes]

        def read(number: int) -> None:
            with contextlib.closing(ShardedStore.open(url, read_only=True)) as mine:
                while not ending.is_set():
                    inside = mine.snapshot() if number else contextlib.nullcontext()
                    try:
                        with inside:
                            rows = everything(mine)
                            again = everything(mine) if number else rows
                    except OutdatedError:
                        n_outdated[number] += 1
                        continue
                    assert listed(rows) == listed(again)
                    assert rows.keys[rows.ids == 5].tolist() in known
                    for object_id, keys in others.items():
                        assert object_id == 5 or rows.keys[rows.ids == object_id].tolist() == keys
                    n_read[number] += 1

        def write() -> None:
            with contextlib.closing(ShardedStore.open(url)) as mine:
                n = 0
                while not ending.is_set():
                    n += 1
                    replace(mine, 5, shapes[n % 3])

        def run(work: Callable[..., None], *args: int) -> None:
            try:
                work(*args)
            except BaseException as error:  # noqa: BLE001 - the test raises it
                troubles.append(error)
                ending.set()

        threads = [threading.Thread(target=run, args=(read, n)) for n in range(3)]
        threads.append(threading.Thread(target=run, args=(write,)))
        for thread in threads:
            thread.start()
        try:
            mover, n_batches = store._rebalancer, 0
            number = mover._begun()
            for cells in ((0, 20, 40), (0, 0, 10), (0, 50, 60)):
                wanted = np.array(cells, dtype=np.int64) << CELL_SHIFT
                while not ending.is_set() and mover._moved(wanted, number) is not None:
                    n_batches += 1
                mover._deleted(number)
            store.rebalance()
        finally:
            ending.set()
            for thread in threads:
                thread.join(PATIENCE)
        assert troubles == []
        assert n_batches > 20
        assert min(n_read) > 0
        after = everything(store)
        for object_id, keys in others.items():
            assert object_id == 5 or after.keys[after.ids == object_id].tolist() == keys
        assert after.keys[after.ids == 5].tolist() in known


def test_a_snapshot_keeps_its_rows_until_it_ends(sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url, read_only=True)) as other:
        store.give_to(0)
        with other.snapshot():
            rows = listed(everything(other))

            def work() -> None:
                store.give_to(threading.get_ident())
                store.rebalance()

            ended = threading.Thread(target=work)
            ended.start()
            moved = "SELECT count(*) FROM shard, distribution WHERE first_key < %s AND epoch > %s"
            with contextlib.closing(ShardedStore.open(url, read_only=True)) as third:
                for _ in range(int(PATIENCE / 0.05)):
                    if third.connection.rows(moved, (64 << CELL_SHIFT, 5)) == [(3,)]:
                        break
                    ended.join(0.05)
            assert listed(everything(other)) == rows
            assert ended.is_alive()
        ended.join(PATIENCE)
        assert not ended.is_alive()
        assert listed(everything(other)) == rows


def test_a_snapshot_that_lasts_too_long_learns_that_its_rows_have_gone(
    sharded_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rebalancing, "SNAPSHOT_SECONDS", 0.0)
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url, read_only=True)) as other:
        rows = listed(everything(other))
        with other.snapshot():
            store.rebalance()
            with pytest.raises(OutdatedError):
                everything(other)
        assert listed(everything(other)) == rows


@pytest.mark.parametrize("limit", [1, 7, 50])
def test_rows_read_piece_by_piece_miss_none_as_borders_move(
    sharded_place: Place, limit: int
) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url, read_only=True)) as other:
        before = everything(store)
        mover = store._rebalancer
        number = mover._begun()
        places = [(0, 20, 40), (0, 1, 64), (0, 0, 0), (0, 64, 64), (0, 30, 31)]
        key, object_id, n_asked = -1, 0, 0
        found: list[tuple[int, int]] = []
        while len(rows := other.checker().rows_after(key, object_id, limit)):
            key, object_id = int(rows.keys[-1]), int(rows.ids[-1])
            found += zip(rows.keys.tolist(), rows.ids.tolist(), strict=True)
            if n_asked % max(100 // limit, 1) == 0:
                wanted = np.array(places[n_asked % 5], dtype=np.int64) << CELL_SHIFT
                mover._moved(wanted, number)  # one batch of it
            n_asked += 1
        assert found == list(zip(before.keys.tolist(), before.ids.tolist(), strict=True))


# --- refused ------------------------------------------------------------------------------------


def test_a_second_rebalance_at_the_same_time_is_refused(sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url)) as other:
        refusals: list[str] = []

        def second(_: RebalanceProgress) -> None:
            if not refusals:
                with pytest.raises(BusyError) as caught:
                    other.rebalance()
                refusals.append(str(caught.value))

        store.rebalance(second)
        assert "is being rebalanced by another" in refusals[0]
        assert "\n" not in refusals[0]
        assert other.rebalance().moved_rows == 0


def test_a_rebalance_that_has_lost_its_lock_changes_nothing_more(sharded_place: Place) -> None:
    url = sharded_place()
    with made(url) as store, contextlib.closing(ShardedStore.open(url)) as other:
        before = contents(store)
        mine, later = store._rebalancer, other._rebalancer
        old = mine._begun()
        wanted = np.array([0, 20, 40], dtype=np.int64) << CELL_SHIFT
        while mine._moved(wanted, old) is not None:
            pass
        state = mine._state()
        # the later one moves all rows back to the first shard, where copies still lie
        number = later._begun()
        back = np.array([0, 64, 64], dtype=np.int64) << CELL_SHIFT
        while later._moved(back, number) is not None:
            pass
        with pytest.raises(BusyError, match="another rebalance has begun"):
            mine._moved(wanted, old)
        shard = mine._shards.connection(0)
        with pytest.raises(BusyError, match="another rebalance has begun"):
            mine._delete(shard, mine._row_ends(state.borders)[0], state.epoch, old)
        carrier = carrying.Carrier("brick", row_shift("brick"), old)
        move = Move(1, 0, 20 << CELL_SHIFT, 40 << CELL_SHIFT, is_from_top=False)
        with pytest.raises(BusyError, match="another rebalance has begun"):
            carrier.carry(mine._shards.connection(1), shard, move, state.epoch)
        assert contents(store) == before


def test_only_the_owner_rebalances(sharded_place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServerConnection, "is_owner", lambda _: False)
    with (
        contextlib.closing(ShardedStore.create(sharded_place(), GRID)) as store,
        pytest.raises(AccessError, match="only the owner"),
    ):
        store.rebalance()


def test_an_import_into_an_empty_environment_comes_first(sharded_place: Place) -> None:
    url = sharded_place()
    with (
        contextlib.closing(ShardedStore.create(url, GRID)) as store,
        contextlib.closing(ShardedStore.open(url)) as other,
        store.loading(),
    ):
        write_voxels(store, shape(1))
        with pytest.raises(BusyError, match="being imported into"):
            other.rebalance()


def test_it_goes_on_when_a_shard_is_back(
    sharded_place: Place, sharded_servers: ShardedServers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "RECONNECT_SECONDS", 0.1)
    with made(sharded_place()) as store:
        before = contents(store)
        n_told = 0

        def kill_the_third(_: RebalanceProgress) -> None:
            nonlocal n_told
            n_told += 1
            if n_told == 2:
                sharded_servers.shards[2].kill()

        with pytest.raises(ShardAwayError, match="shard 3"):
            store.rebalance(kill_the_third)
        sharded_servers.shards[2].start()
        assert contents(store) == before
        report = store.rebalance()
        assert contents(store) == before
        assert report.moved_rows
        assert_only_own_rows(sharded_servers, store)
