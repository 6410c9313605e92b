"""All shards' rows as tables at the coordinator: plans, rows, what is whole, borders, rights."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import psycopg
import pytest
from hypothesis import given
from hypothesis import strategies as st
from psycopg import sql

from foreign_cluster import (
    CELL_KEYS,
    CELLS,
    ENVIRONMENT,
    EQUAL_BORDERS,
    N_SHARDS,
    Cluster,
    Kept,
    cluster,  # noqa: F401 - a fixture
    filled,  # noqa: F401 - a fixture
    spread,
)
from hapticdb import AccessError, UsageError
from hapticdb.store.base import CELL_SHIFT
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.shards import foreign
from hapticdb.store.postgres.shards.foreign import OwnedCells
from hapticdb.store.postgres.tables import statements

BY_CELLS = "SELECT z_val, id, occupancy FROM brick_live WHERE cell = ANY (%s)"

# --- plans --------------------------------------------------------------------------------------


def plan_of(cluster: Cluster, text: str, parameters: "Parameters") -> dict[str, Any]:
    """Plan of a statement that the client has filled in, as a custom plan is."""
    with psycopg.ClientCursor(cluster.coordinator.driver) as cursor:
        cursor.execute(f"EXPLAIN (VERBOSE, FORMAT JSON) {text}", parameters)
        row = cursor.fetchone()
    assert row is not None
    plan: dict[str, Any] = row[0][0]["Plan"]
    return plan


def nodes_of(plan: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield plan
    for child in plan.get("Plans", ()):
        yield from nodes_of(child)


def foreign_scans(plan: dict[str, Any]) -> list[dict[str, Any]]:
    return [node for node in nodes_of(plan) if node["Node Type"] == "Foreign Scan"]


def joins_over_foreign(plan: dict[str, Any]) -> list[str]:
    """Joins, at the coordinator or sent to a shard, one of whose inputs is a foreign table."""
    found = []
    for node in nodes_of(plan):
        is_join = "Join" in node["Node Type"] or node["Node Type"] == "Nested Loop"
        inputs = [child for child in node.get("Plans", ()) if "Subplan Name" not in child]
        if is_join and any(foreign_scans(child) for child in inputs):
            found.append(node["Node Type"])
        if " JOIN " in node.get("Remote SQL", ""):
            found.append("Remote SQL")
    return found


def without_condition(plan: dict[str, Any]) -> list[str]:
    """Remote statements for rows that would send all rows of a shard."""
    remote = [node["Remote SQL"] for node in foreign_scans(plan)]
    return [text for text in remote if "cell" not in text.partition(" WHERE ")[2]]


def asked(plan: dict[str, Any]) -> set[int]:
    """Numbers of the shards that a plan asks."""
    return {int(node["Relation Name"].rpartition("_")[2]) for node in foreign_scans(plan)}


FIGURE_3 = foreign.WRENCH["brick"]


def filled_in(keys: list[int]) -> tuple[str, dict[str, Any]]:
    """Figure 3 with parameters that psycopg can put in."""
    floats = [0.5] * len(keys)
    kinds: list[tuple[str, Any]] = [("bigint[]", keys), *[("float8[]", floats)] * 6]
    kinds += [*[("float8", 0.25)] * 4, ("bigint[]", sorted({k >> CELL_SHIFT for k in keys}))]
    text = FIGURE_3
    for n in range(len(kinds), 0, -1):
        text = text.replace(f"${n}", f"%(p{n})s::{kinds[n - 1][0]}")
    return text, {f"p{n}": value for n, (_, value) in enumerate(kinds, 1)}


ONE_SHARD, TWO_SHARDS = [11, 13, 19], [3, 9, 12]
Parameters = tuple[Any, ...] | dict[str, Any]
PLANNED: list[tuple[str, str, Parameters, set[int]]] = [
    ("cells of one shard", BY_CELLS, (ONE_SHARD,), {2}),
    ("cells of two shards", BY_CELLS, (TWO_SHARDS,), {1, 2}),
    (
        "a range of cells",
        "SELECT z_val FROM brick_live WHERE cell BETWEEN %s AND %s AND z_val BETWEEN %s AND %s",
        (9, 12, 64 * 9 + 3, 64 * 13),
        {1, 2},
    ),
    (
        "ranges",
        "SELECT z_val FROM brick_live WHERE cell BETWEEN %s AND %s OR cell BETWEEN %s AND %s",
        (0, 2, 25, 26),
        {1, 3},
    ),
    (
        "cells and keys",
        "SELECT z_val FROM brick_live WHERE cell = ANY (%s) AND z_val = ANY (%s)",
        ([29], [64 * 29 + 7]),
        {3},
    ),
    ("distances", "SELECT z_val, distances FROM band_live WHERE cell = ANY (%s)", ([0, 1],), {1}),
    ("Figure 3", *filled_in([CELL_KEYS * 11 + 5, CELL_KEYS * 21 + 9]), {2, 3}),
]


@pytest.mark.parametrize(
    ("text", "parameters", "shards"),
    [pytest.param(*case[1:], id=case[0]) for case in PLANNED],
)
def test_a_plan_asks_the_owners_for_their_cells_and_joins_no_foreign_table(
    filled: Cluster, text: str, parameters: "Parameters", shards: set[int]
) -> None:
    plan = plan_of(filled, text, parameters)
    assert asked(plan) == shards
    assert without_condition(plan) == []
    assert joins_over_foreign(plan) == []


def test_the_checks_of_plans_notice_a_join_and_a_scan_of_everything(filled: Cluster) -> None:
    """The form of `statements.SCAN` fetches whole shards: no statement may use it here."""
    text = (
        "SELECT z_val FROM unnest(%s::bigint[], %s::bigint[]) AS range(low, high)"
        " JOIN brick_live ON cell BETWEEN range.low AND range.high"
    )
    plan = plan_of(filled, text, ([1, 3], [1, 4]))
    assert asked(plan) == {1, 2, 3}
    assert len(without_condition(plan)) == N_SHARDS
    assert joins_over_foreign(plan)


def test_several_shards_are_asked_at_once(filled: Cluster) -> None:
    plan = plan_of(filled, BY_CELLS, (TWO_SHARDS,))
    assert [node["Async Capable"] for node in foreign_scans(plan)] == [True, True]


def test_a_plan_for_any_cells_asks_every_shard_and_still_sends_the_condition(
    filled: Cluster,
) -> None:
    """A generic plan leaves out no partition, which is why sessions use custom plans."""
    driver = filled.coordinator.driver
    driver.execute("PREPARE by_cells (bigint[]) AS " + BY_CELLS.replace("%s", "$1"))
    plans = {}
    for mode in ("force_custom_plan", "force_generic_plan"):
        driver.execute(f"SET plan_cache_mode = {mode}")
        explain = "EXPLAIN (VERBOSE, FORMAT JSON) EXECUTE by_cells ('{11,13}')"
        row = driver.execute(explain).fetchone()
        assert row is not None
        plans[mode] = row[0][0]["Plan"]
    driver.execute("DEALLOCATE by_cells")
    driver.execute(foreign.CUSTOM_PLANS)
    assert asked(plans["force_custom_plan"]) == {2}
    assert asked(plans["force_generic_plan"]) == {1, 2, 3}
    assert without_condition(plans["force_generic_plan"]) == []


@pytest.mark.parametrize(
    "condition",
    [
        "cell = ANY ('{11,13,19}')",
        "cell BETWEEN 11 AND 12",
        "cell BETWEEN 11 AND 12 OR cell BETWEEN 14 AND 15",
    ],
)
def test_a_shard_looks_cells_up_in_its_index(filled: Cluster, condition: str) -> None:
    """The remote statement as a cursor of a shard, with the settings that the coordinator gives."""
    text = f"SELECT z_val, id, occupancy FROM brick_live WHERE {condition}"
    (scan,) = foreign_scans(plan_of(filled, text, ()))
    shard = filled.shards[1]
    with shard.transaction():
        for setting in foreign.SETTINGS_THERE.removeprefix("-c ").split(" -c "):
            shard.execute(f"SET LOCAL {setting}")
        explain = "EXPLAIN (FORMAT JSON) DECLARE rows CURSOR FOR "
        row = shard.execute(explain + scan["Remote SQL"]).fetchone()
    assert row is not None
    nodes = list(nodes_of(row[0][0]["Plan"]))
    assert {node["Index Name"] for node in nodes if "Index Name" in node} == {"brick_cell"}
    assert all("z_val >> 6" in node["Index Cond"] for node in nodes if "Index Name" in node)
    assert "Seq Scan" not in {node["Node Type"] for node in nodes}


# --- rows ---------------------------------------------------------------------------------------

row = st.tuples(st.integers(0, 64 * CELLS - 1), st.integers(1, 4), st.integers(100, 104))
borders = st.lists(st.integers(0, CELLS), min_size=2, max_size=2).map(lambda b: [0, *sorted(b)])


@given(
    rows=st.lists(row, max_size=40, unique=True),
    copied=st.lists(st.tuples(st.integers(0, 39), st.integers(0, 2)), max_size=10),
    versions=st.dictionaries(st.integers(1, 4), st.integers(100, 104)),
    first_cells=borders,
    cells=st.lists(st.integers(0, CELLS - 1), min_size=1, max_size=12, unique=True),
)
def test_rows_are_those_of_a_plain_table(
    cluster: Cluster,
    rows: list[Kept],
    copied: list[tuple[int, int]],
    versions: dict[int, int],
    first_cells: list[int],
    cells: list[int],
) -> None:
    """Versions that do not count are left out, and copies at shards that do not own the cell."""
    held: list[set[Kept]] = [set(), set(), set()]
    for kept in rows:
        owner = sum(first <= kept[0] >> 6 for first in first_cells) - 1
        held[owner].add(kept)
    for n, shard in copied:
        if n < len(rows):
            held[shard].add(rows[n])
    for n, there in enumerate(held):
        cluster.keep(n, sorted(there))
    cluster.live(versions)
    cluster.align(first_cells)
    wanted = sorted(
        (z, number)
        for z, number, version in rows
        if versions.get(number) == version and z >> 6 in cells
    )
    found = cluster.coordinator.rows(BY_CELLS, (cells,))
    assert sorted((z, number) for z, number, _ in found) == wanted
    assert all(bits.hex() == f"{z % 65536:x}".rjust(128, "1") for z, _, bits in found)


def test_a_row_that_two_shards_have_counts_once(filled: Cluster) -> None:
    """While a border moves from cell 10 to 13, the shard before has a copy of the rows."""
    filled.keep(0, spread(range(13)))
    assert len(filled.coordinator.rows(BY_CELLS, ([9, 11],))) == 2 * 9
    from_both = filled.coordinator.rows(BY_CELLS.replace("brick_live", "brick_all"), ([9, 11],))
    assert len(from_both) == 3 * 9


@given(seed=st.integers(0, 2**32 - 1), n_points=st.integers(1, 80))
def test_figure_3_gives_the_wrench_of_one_server_bit_for_bit(
    cluster: Cluster, seed: int, n_points: int
) -> None:
    draw = np.random.default_rng(seed)
    first_cells = [0, *sorted(draw.integers(0, CELLS, 2).tolist())]
    cluster.live({1: 101, 2: 102, 3: 103})
    lasts = [*first_cells[1:], CELLS]
    for n in range(N_SHARDS):
        cluster.keep(n, spread(range(first_cells[n], lasts[n])))
    cluster.align(first_cells)
    coordinator = cluster.coordinator
    coordinator.execute("TRUNCATE brick")
    for shard in cluster.shards:
        with coordinator.driver.cursor() as cursor:
            cursor.executemany(
                "INSERT INTO brick (z_val, id, occupancy) VALUES (%s, %s, %s)",
                shard.execute("SELECT z_val, id, occupancy FROM brick").fetchall(),
            )
    keys = np.sort(draw.integers(0, CELLS * CELL_KEYS, n_points))
    shell = [wire.int8s(keys), *(wire.float8s(draw.normal(size=n_points)) for _ in range(6))]
    shell += [wire.float8(float(x)) for x in draw.normal(size=4)]
    cells = wire.int8s(np.unique(keys >> CELL_SHIFT))
    plain = coordinator.fetch(statements.WRENCH["brick"], *shell)
    sharded = coordinator.fetch(foreign.WRENCH["brick"], *shell, cells)
    coordinator.execute("TRUNCATE brick")
    assert sharded == plain


# --- what is whole ------------------------------------------------------------------------------

IS_WHOLE = "SELECT is_whole FROM shard_check"


@pytest.mark.parametrize(
    "change", ["swept = 1", "moved = 1", "writes = -1", "token = gen_random_uuid()"]
)
def test_a_mark_that_does_not_fit_is_told(filled: Cluster, change: str) -> None:
    assert filled.coordinator.rows(IS_WHOLE) == [(True,)]
    filled.shards[2].execute(f"UPDATE mark SET {change}")
    assert filled.coordinator.rows(IS_WHOLE) == [(False,)]


def test_rows_and_marks_of_one_statement_are_of_one_moment(filled: Cluster) -> None:
    """What a sweep deletes between the rows and the mark is seen in both or in neither."""
    both = f"SELECT (SELECT count(*) FROM ({BY_CELLS}) AS held), is_whole FROM shard_check"
    everything = list(range(CELLS))
    driver = filled.coordinator.driver
    with driver.transaction():
        driver.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
        before = driver.execute(both, (everything,)).fetchall()
        for shard in filled.shards:
            shard.execute("DELETE FROM brick")
            shard.execute("UPDATE mark SET swept = 9")
        again = driver.execute(both, (everything,)).fetchall()
    after = filled.coordinator.rows(both, (everything,))
    assert (before, again, after) == ([(9 * CELLS, True)], [(9 * CELLS, True)], [(0, False)])


def test_a_later_statement_of_a_transaction_tells_that_its_rows_are_older(filled: Cluster) -> None:
    """READ COMMITTED: `live` is new, the shard's snapshot is old, and so the rows are missing."""
    driver = filled.coordinator.driver
    other = psycopg.connect(driver.info.dsn, password=driver.info.password, autocommit=True)
    with other:
        other.execute(sql.SQL("SET search_path = {}").format(sql.Identifier(ENVIRONMENT)))
        with driver.transaction():
            driver.execute("SET TRANSACTION ISOLATION LEVEL READ COMMITTED")
            everything = list(range(CELLS))
            assert len(driver.execute(BY_CELLS, (everything,)).fetchall()) == 9 * CELLS
            assert driver.execute(IS_WHOLE).fetchall() == [(True,)]
            filled.shards[1].execute(
                "INSERT INTO brick SELECT z_val, id, occupancy, 555 FROM brick WHERE id = 1"
            )
            filled.shards[1].execute("UPDATE mark SET writes = writes + 1")
            other.execute("UPDATE shard SET writes = writes + 1 WHERE number = 2")
            other.execute("UPDATE live SET version = 555 WHERE id = 1")
            assert len(driver.execute(BY_CELLS, (everything,)).fetchall()) == 6 * CELLS
            assert driver.execute(IS_WHOLE).fetchall() == [(False,)]
    found = filled.coordinator.rows(BY_CELLS, (everything,))
    assert len(found) == 6 * CELLS + 3 * 10
    assert filled.coordinator.rows(IS_WHOLE) == [(True,)]


# --- borders, servers, rights -------------------------------------------------------------------

KEPT_THINGS = """
SELECT (SELECT array_agg(oid ORDER BY srvname) FROM pg_foreign_server),
       'brick_all'::regclass::oid, 'brick_live'::regclass::oid, 'shard_check'::regclass::oid"""


def test_moved_borders_keep_servers_parents_and_rights(filled: Cluster) -> None:
    role = f"viewer_{os.getpid()}"
    coordinator, name = filled.coordinator, sql.Identifier(role)
    coordinator.execute(sql.SQL("CREATE ROLE {}").format(name))
    try:
        schema = sql.Identifier(ENVIRONMENT)
        for what in ("USAGE ON SCHEMA {1}", "SELECT ON ALL TABLES IN SCHEMA {1}"):
            coordinator.execute(sql.SQL(f"GRANT {what} TO {{0}}").format(name, schema))
        before = coordinator.rows(KEPT_THINGS)
        filled.align([0, 5, 25])
        assert coordinator.rows(KEPT_THINGS) == before
        assert asked(plan_of(filled, BY_CELLS, ([7],))) == {2}
        with coordinator.driver.transaction():  # the view's owner asks the shards, not the viewer
            coordinator.execute(sql.SQL("SET LOCAL ROLE {}").format(name))
            assert len(coordinator.execute(BY_CELLS, ([2],)).fetchall()) == 9
    finally:
        coordinator.execute(sql.SQL("DROP OWNED BY {}").format(name))
        coordinator.execute(sql.SQL("DROP ROLE {}").format(name))


def test_a_shard_that_goes_takes_its_server_along(filled: Cluster) -> None:
    filled.align([0, 15])
    found = filled.coordinator.rows("SELECT count(*) FROM pg_foreign_server")
    assert found == [(2,)]
    assert len(filled.coordinator.rows("SELECT * FROM shard_mark")) == 2
    filled.align(EQUAL_BORDERS)
    assert len(filled.coordinator.rows("SELECT * FROM shard_mark")) == N_SHARDS


def test_withdraw_leaves_no_server_and_align_makes_them_again(filled: Cluster) -> None:
    filled.coordinator.write(lambda: foreign.withdraw(filled.coordinator))
    assert filled.coordinator.rows("SELECT count(*) FROM pg_foreign_server") == [(0,)]
    filled.align(EQUAL_BORDERS)
    assert len(filled.coordinator.rows(BY_CELLS, (TWO_SHARDS,))) == 9 * len(TWO_SHARDS)


@pytest.mark.parametrize("has_extension", [True, False])
def test_a_user_without_the_right_gets_one_clear_line(filled: Cluster, has_extension: bool) -> None:
    coordinator, name = filled.coordinator, sql.Identifier(f"owner_{os.getpid()}")
    schema = sql.Identifier(ENVIRONMENT)

    def work() -> None:
        foreign.withdraw(coordinator)
        for statement in (
            "DROP VIEW IF EXISTS brick_live, band_live, shard_mark CASCADE",
            "DROP TABLE brick_all, band_all",
            "SELECT 1" if has_extension else "DROP EXTENSION postgres_fdw",
            "CREATE ROLE {0}",
            "GRANT ALL ON SCHEMA {1} TO {0}",
            "GRANT SELECT ON shard, environment TO {0}",
            "SET LOCAL ROLE {0}",
        ):
            coordinator.execute(sql.SQL(statement).format(name, schema))
        foreign.align(coordinator, "brick", filled.places)

    with pytest.raises(AccessError, match="GRANT USAGE ON FOREIGN DATA WRAPPER") as caught:
        coordinator.write(work)  # rolled back, with the role
    assert "\n" not in str(caught.value)


def test_a_shard_without_a_place_is_refused(filled: Cluster) -> None:
    place = filled.places.pop(3)
    try:
        with pytest.raises(UsageError, match="no place for shard 3"):
            filled.align(EQUAL_BORDERS)
    finally:
        filled.places[3] = place
    assert len(filled.coordinator.rows(BY_CELLS, ([29],))) == 9


def test_parts_leave_out_shards_without_cells() -> None:
    shards = [(1, 0), (2, 4 * CELL_KEYS), (3, 4 * CELL_KEYS), (4, 9 * CELL_KEYS)]
    assert foreign.parts_of(shards) == [
        OwnedCells(1, 0, 4),
        OwnedCells(3, 4, 9),
        OwnedCells(4, 9, None),
    ]


@pytest.mark.parametrize(
    "firsts", [[], [CELL_KEYS], [0, 2 * CELL_KEYS, CELL_KEYS], [0, CELL_KEYS + 1]]
)
def test_borders_that_do_not_fit_are_refused(firsts: list[int]) -> None:
    with pytest.raises(UsageError, match="ascend from 0"):
        foreign.parts_of(list(enumerate(firsts, 1)))
