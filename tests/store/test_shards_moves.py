"""Which rows go where when borders between shards move."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from hapticdb.store.base import CELL_SHIFT, Keys
from hapticdb.store.postgres.shards.borders import moves
from hapticdb.store.postgres.shards.borders.moves import Move, all_moves, borders_after, part_of
from hapticdb.store.postgres.shards.statistics import joined_histograms

N_CELLS = 40


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
