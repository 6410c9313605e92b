"""Resident cells equal the database after any loads, evictions and writes."""

import itertools
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from children import joined
from hapticdb import Environment, PointShell
from hapticdb.errors import UsageError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.records.cells import BUFFERS
from hapticdb.kernels.resident.cells import UNKNOWN, cell_key
from hapticdb.resident import changes
from hapticdb.resident import residency as module
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.resident.writer import ROUNDS_KEPT
from hapticdb.store.connect import open_store
from naive import Voxel
from session.worlds import Reader, block, cells_of, make, move, scatter
from voxels import voxel_object, write_voxels

NOTHING = np.empty(0, dtype=np.int64)


@pytest.fixture
def table() -> Iterator[CellTable]:
    with CellTable.create(LEAST_BUDGET) as made:
        yield made


def voxels_by_cell(env: Environment, exclude: tuple[int, ...] = ()) -> dict[int, set[Voxel]]:
    found: dict[int, set[Voxel]] = {}
    for obj in env.objects():
        if obj.id not in exclude:
            for v in env.voxels(obj.id).tolist():
                found.setdefault(int(cell_key(*v)), set()).add((v[0], v[1], v[2]))
    return found


def check(residency: Residency, wanted: dict[int, set[Voxel]]) -> int:
    """Assert that every published cell holds exactly its voxels; return how many are published."""
    table = residency.table
    which = table.version % BUFFERS
    entries = np.flatnonzero(table.cells.keys[which] >= 0)
    cells, slots = table.cells.keys[which][entries], table.cells.slots[which][entries]
    filled = slots[slots > 0].tolist()
    assert len(set(filled)) == len(filled)
    assert not set(filled) & set(residency.writer.slots._free)
    retired = {slot for _, held in residency.writer.slots._retired for slot in held}
    assert len(filled) + len(residency.writer.slots._free) + len(retired) == table.n_slots - 1
    assert residency.writer.n_resident == len(filled)
    assert residency.writer.n_empty == len(slots) - len(filled)
    assert len(entries) <= table.capacity // 2
    for key, slot in zip(cells.tolist(), slots.tolist(), strict=True):
        low = (key >> 32 << 5, (key >> 16 & 0xFFFF) << 5, (key & 0xFFFF) << 5)
        bits = table.cells.words[slot][:, None] >> np.arange(32, dtype=np.uint32) & 1
        found = {
            (low[0] + (w >> 5), low[1] + (w & 31), low[2] + b)
            for w, b in np.argwhere(bits).tolist()
        }
        assert found == wanted.get(key, set())
        assert bool(found) == (slot > 0)
    return len(entries)


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("load"), st.integers(0, 511), st.integers(1, 120)),
        st.tuples(st.just("move"), st.integers(1, 3), st.integers(0, 99)),
        st.tuples(st.just("restart"), st.integers(0, 511), st.integers(0, 120)),
        st.tuples(st.just("refresh"), st.just(0), st.just(0)),
    ),
    min_size=1,
    max_size=14,
)


@given(STEPS)
@settings(deadline=None, max_examples=6)
def test_residency_random_steps_equal_database(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int, int]]
) -> None:
    """After loads and evictions in any order, writes of others, and new writers."""
    env = make(tmp_path_factory.mktemp("steps"), bits=8)
    scatter(env, n_voxels=800)
    store = open_store(env.url, read_only=True)
    cells = cells_of(env.grid)
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(store, table)
        for kind, first, second in steps:
            if kind == "load":
                residency.begin_round()
                asked = residency.missing(cells[first : first + second])
                residency.load(asked)
            elif kind == "move":
                at = np.random.default_rng(second).integers(0, 220, 3)
                move(env.store, first, block(at, at + 11))
            elif kind == "restart":
                urgent = cells[first : first + second]
                residency = Residency(store, table, urgent=urgent)
            else:
                residency.refresh()
            if kind != "move":
                assert table.revision == residency.revision
            if residency.revision == store.revision():
                check(residency, voxels_by_cell(env))
    store.close()
    env.close()


def test_residency_follows_filter_words(tmp_path: Path, table: CellTable) -> None:
    """What others add is in the cells if the words choose it then."""

    def named(name: str, number: int, material: str) -> int:
        ijk = block((16 * number, 3, 3), (16 * number + 40, 9, 9))
        record = replace(voxel_object(env.grid, ijk, name), attributes={"material": material})
        return env.store.add(record, rows_of_voxels(ijk, env.grid, env.layout))

    def check_cells(residency: Residency, *excluded: int) -> None:
        residency.make_resident(cells_of(env.grid)[:40])
        assert check(residency, voxels_by_cell(env, excluded))

    env = make(tmp_path)
    named("a1", 0, "steel"), named("a2", 1, "wood"), named("b", 2, "steel")
    store = open_store(env.url, read_only=True)
    by_material = Residency(store, table, ["b"], where=["material=steel"])
    with CellTable.create(LEAST_BUDGET) as other:
        by_name = Residency(store, other, where=["a*"])
        check_cells(by_material, 2, 3)
        check_cells(by_name, 3)
        named("c", 3, "steel"), named("d", 3, "wood")
        assert by_material.refresh() == by_name.refresh() == 2
        check_cells(by_material, 2, 3, 5)
        check_cells(by_name, 3, 4, 5)
        assert by_name.exclude.tolist() == [3, 4, 5]
        env.remove(3)
        named("a*", 9, "wood")
        for residency in (by_material, by_name):
            residency.refresh()
        check_cells(by_material, 2, 5, 6)
        check_cells(by_name, 1, 2, 4, 5)
        before = by_name.revision
        move(env.store, 1, block((5, 5, 5), (9, 9, 9)))
        assert (by_name.refresh(), by_name.revision) == (1, before + 1)
        check_cells(by_name, 1, 2, 4, 5)
    store.close()


def full_of_voxels(folder: Path, bits: int = 8) -> Environment:
    """An environment with a voxel in every cell."""
    env = make(folder, bits=bits)
    n = env.grid.side >> 5
    write_voxels(env.store, 32 * block((0, 0, 0), (n - 1, n - 1, n - 1)) + 7)
    return env


def test_residency_evicts_unwanted_cells_only(tmp_path: Path, table: CellTable) -> None:
    env = full_of_voxels(tmp_path)
    residency = Residency(env.store, table)
    cells = cells_of(env.grid)
    kept = cells[:100]
    residency.load(residency.missing(kept)[:100])
    while len(missing := residency.missing(kept)):
        residency.load(missing)
    for at in range(100, 512, 40):
        residency.begin_round()
        assert not len(residency.missing(kept))
        residency.load(cells[at : at + 40])
        assert (residency.slots_of(cells[at : at + 40]) > 0).all()
    assert (residency.slots_of(kept) > 0).all()
    assert residency.writer.n_evicted > 0
    check(residency, voxels_by_cell(env))


def test_residency_tool_larger_than_table(tmp_path: Path, table: CellTable) -> None:
    """Also with a new writer, which reads as many again as there is room for."""
    env = full_of_voxels(tmp_path)
    residency = Residency(env.store, table)
    cells = cells_of(env.grid)
    for _ in range(20):
        residency.begin_round()
        residency.load(residency.missing(cells))
    resident = residency.slots_of(cells) > 0
    assert resident.sum() == table.n_slots - 1
    assert residency.writer.n_evicted == 0
    for _ in range(2 * ROUNDS_KEPT):
        residency.begin_round()
        assert residency.load(residency.missing(cells)).cells == 0
    assert (residency.slots_of(cells) > 0).tolist() == resident.tolist()
    urgent = cells[resident]
    residency = Residency(env.store, table, urgent=urgent)
    n_read = check(residency, voxels_by_cell(env))
    assert n_read == table.n_slots // 3
    assert (residency.slots_of(urgent[:n_read]) > 0).all()


def test_residency_empty_cells_bounded(tmp_path: Path, table: CellTable) -> None:
    env = make(tmp_path, bits=9)  # 4096 cells, all without voxels
    residency = Residency(env.store, table)
    cells = cells_of(env.grid)
    near = cells[:40]
    for at in range(0, 4096, 40):
        residency.load(residency.missing(cells[at : at + 40]))
        residency.want(near, residency.slots_of(near))
        residency.load(residency.missing(near))
        assert (residency.slots_of(near) == 0).all()
    assert residency.writer.n_empty <= table.capacity // 2 - table.n_slots
    assert check(residency, {}) > 200


def test_residency_write_during_load(tmp_path: Path, table: CellTable) -> None:
    """One version has both: the new cells, and the known cells read again."""
    env = make(tmp_path)
    scatter(env)
    residency = Residency(open_store(env.url, read_only=True), table)
    cells = cells_of(env.grid)
    residency.load(residency.missing(cells[:40]))
    before = table.version
    move(env.store, 1, block((10, 10, 10), (100, 60, 40)))
    residency.load(residency.missing(cells)[:20])
    assert (table.version, table.revision) == (before + 1, env.store.revision())
    assert check(residency, voxels_by_cell(env)) == 60


def test_residency_refresh_most_urgent_cells(
    tmp_path: Path, table: CellTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_RENEWED", 10)
    env = full_of_voxels(tmp_path, bits=7)
    residency = Residency(open_store(env.url, read_only=True), table)
    cells = np.random.default_rng(0).permutation(cells_of(env.grid))
    residency.load(residency.missing(cells))
    residency.want(cells, residency.slots_of(cells))
    move(env.store, 1, block((0, 0, 0), (127, 127, 10)))
    residency.refresh()
    assert np.flatnonzero(residency.slots_of(cells) != UNKNOWN).tolist() == list(range(10))
    check(residency, voxels_by_cell(env))


@pytest.mark.parametrize("few", [0, 1 << 14])
def test_residency_writes_elsewhere_leave_cells(
    tmp_path: Path, table: CellTable, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For both ways in which the cells of a write are found."""
    monkeypatch.setattr(changes, "FEW_CELLS", few)
    env = full_of_voxels(tmp_path, bits=7)
    second = write_voxels(env.store, block((1, 1, 1), (3, 3, 3)), "second")
    residency = Residency(open_store(env.url, read_only=True), table)
    cells = cells_of(env.grid)
    residency.load(residency.missing(cells))
    slots = residency.slots_of(cells)
    move(env.store, second, block((1, 1, 100), (3, 3, 103)))
    assert residency.refresh() == 1
    changed = np.flatnonzero(residency.slots_of(cells) != slots)
    assert cells[changed].tolist() == [0, 3]
    check(residency, voxels_by_cell(env))


def test_residency_server_lost_commits(tmp_path: Path, table: CellTable) -> None:
    env = full_of_voxels(tmp_path, bits=7)
    residency = Residency(env.store, table)
    residency.load(residency.missing(cells_of(env.grid)))
    residency.want(NOTHING, NOTHING)
    residency._revision += 1
    residency.refresh()
    assert residency.revision == env.store.revision()
    assert (residency.writer.n_resident, residency.writer.n_empty) == (0, 0)


def test_residency_slots_of_failed_load_reused(
    tmp_path: Path, table: CellTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = full_of_voxels(tmp_path, bits=7)
    residency = Residency(open_store(env.url, read_only=True), table)
    cells = cells_of(env.grid)
    residency.load(residency.missing(cells[:30]))
    move(env.store, 1, block((0, 0, 0), (127, 127, 10)))
    read_batch = residency._read_batch

    def read_and_fail(asked: NDArray[np.int64]) -> None:
        read_batch(asked)
        raise hapticdb.errors.ConnectionLostError("gone")

    monkeypatch.setattr(residency, "_read_batch", read_and_fail)
    with pytest.raises(hapticdb.errors.ConnectionLostError):
        residency.load(cells[30:40])
    monkeypatch.undo()
    residency.reopened(open_store(env.url, read_only=True))
    check(residency, voxels_by_cell(env))


def test_residency_cells_of_dead_writer_reread(tmp_path: Path, table: CellTable) -> None:
    """The environment may since have been replaced by another with as many writes."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    env, other = make(tmp_path / "first"), make(tmp_path / "second")
    write_voxels(env.store, block((0, 0, 0), (5, 5, 5)))
    write_voxels(other.store, block((8, 8, 8), (70, 70, 70)))
    cells = cells_of(env.grid)
    residency = Residency(env.store, table)
    residency.load(cells)
    check(residency, voxels_by_cell(env))
    before, urgent = table.version, cells[:9]
    residency = Residency(other.store, table, urgent=urgent)
    assert residency.revision == env.store.revision()
    assert table.version == before + 1
    assert check(residency, voxels_by_cell(other)) == len(urgent)
    assert (residency.slots_of(urgent) != UNKNOWN).all()


def test_residency_lexicographic_order_refused(tmp_path: Path, table: CellTable) -> None:
    env = make(tmp_path, layout="voxel", curve="lexicographic")
    with pytest.raises(
        UsageError, match="lexicographic order, which has no cells: 'hapticdb copy'"
    ):
        Residency(env.store, table)


def test_residency_dead_reader_does_not_block_writer(tmp_path: Path, table: CellTable) -> None:
    env = full_of_voxels(tmp_path)
    residency = Residency(env.store, table)
    row = table.join()
    table.queue.pids[row] = 2**22 + 1  # above the largest process id
    table.cells.readers["version"][row] = table.version
    cells = cells_of(env.grid)
    for at in range(0, 400, 50):
        for _ in range(ROUNDS_KEPT + 1):
            residency.begin_round()
        residency.load(cells[at : at + 50])
    assert table.cells.readers["version"][row] == 0
    check(residency, voxels_by_cell(env))


# --- frames at the same time --------------------------------------------------------------------


def shell_of(places: NDArray[np.int64], env: Environment) -> PointShell:
    """A shell that has, at the identity pose, a point at the centre of each voxel."""
    points = env.grid.centers(places)
    return PointShell(
        points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.zeros(3), is_closed=True
    )


def test_residency_no_torn_cell_or_mixed_revision(tmp_path: Path) -> None:
    """Frames run in a thread while the object moves and the writer loads, evicts and refreshes."""
    env = make(tmp_path, bits=8)
    pattern = np.array([[5, 5, 5], [6, 6, 6], [20, 9, 31], [31, 31, 0]])
    corners = 32 * block((0, 0, 0), (7, 7, 7))
    write_voxels(env.store, (corners[:, None] + pattern).reshape(-1, 3), "patterns")
    offsets = np.array([[30, 30, 30], [34, 30, 30], [30, 34, 34], [34, 34, 34]])
    here, there = np.array([96, 64, 64]), np.array([160, 128, 128])
    thing = write_voxels(env.store, here + offsets, "thing")
    store = open_store(env.url, read_only=True)
    probes = np.concatenate([here + offsets, there + offsets, corners[0] + pattern])
    shell = shell_of(np.concatenate([probes, corners[77] + pattern]), env)
    wrong: list[object] = []
    seen: set[tuple[bool, ...]] = set()
    done = threading.Event()
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(store, table)

        def hammer() -> None:
            reader = Reader(table, env.grid, shell)
            while not done.is_set():
                hits, _, unknown = reader.evaluate(np.eye(4))
                met = [sum(4 * n <= hit < 4 * n + 4 for hit in hits) for n in range(4)]
                if unknown == 0 and met[:2] not in ([4, 0], [0, 4]):
                    wrong.append(("two places", met))
                if met[2] not in {0, 4} or met[3] not in {0, 4}:
                    wrong.append(("torn", met))
                seen.add(tuple(count == 4 for count in met))
            table.leave(reader.row)

        thread = threading.Thread(target=hammer, daemon=True)
        thread.start()
        wanted = np.unique([cell_key(*v) for v in probes.tolist()])
        cells = cells_of(env.grid)
        rng = np.random.default_rng(1)
        places = {(True, False), (False, True)}
        for n in itertools.count():
            if n >= 120 and {met[:2] for met in tuple(seen)} >= places:
                break
            assert n < 20_000
            residency.begin_round()
            residency.load(residency.missing(wanted))
            move(env.store, thing, (there if n % 2 == 0 else here) + offsets)
            residency.refresh() if n % 3 else residency.load(residency.missing(wanted))
            others = rng.permutation(cells)[:60]
            residency.load(others[residency.slots_of(others) == UNKNOWN])
        done.set()
        joined(thread)
        check(residency, voxels_by_cell(env))
    assert wrong == []
    assert residency.writer.n_evicted > 0
