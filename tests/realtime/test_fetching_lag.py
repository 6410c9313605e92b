"""The fetching process confirms what a standby answers only up to the last proved instant."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import hapticdb
from hapticdb import Environment
from hapticdb.realtime.fetching import Fetcher, FetchRequest
from hapticdb.resident.table import AWAY, HEARTBEAT, LEAST_BUDGET, CellTable
from hapticdb.store.base import Store
from hapticdb.store.engines import Lag, MayLag
from hapticdb.testing import write_voxels
from realtime.worlds import block, make


class Standby:
    """Passes calls to another store, as one whose answers are proved up to `proved_at`."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.proved_at: int | None = 0
        self.asked: list[int] = []
        self.failure: Exception | None = None

    def begin_proofs(self) -> None:
        if self.failure is not None:
            raise self.failure

    def newest_at(self, revision: int) -> int | None:
        self.asked.append(revision)
        return self.proved_at

    def lag(self) -> Lag | None:
        return None

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the store has
        return getattr(self._store, name)


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    made = make(tmp_path)
    write_voxels(made.store, block((50, 50, 58), (78, 78, 63)))
    return made


Fetching = tuple[Fetcher, CellTable, list[Standby]]


@pytest.fixture
def fetching(env: Environment) -> Iterator[Fetching]:
    opened: list[Standby] = []

    def wrap(store: Store) -> Store:
        opened.append(Standby(store))
        made: Any = opened[-1]
        return made  # type: ignore[no-any-return]

    with CellTable.create(LEAST_BUDGET) as table:
        request = FetchRequest(env.url, table.descriptor, table.n_slots, env.grid, wrap=wrap)
        fetcher = Fetcher(request, clock=_steps())
        yield fetcher, table, opened
        fetcher.close()


def _steps() -> Callable[[], float]:
    """A clock that moves on by a second each time, so that each round asks for the revision."""
    at = [0.0]

    def step() -> float:
        at[0] += 1.0
        return at[0]

    return step


def test_without_a_proof_nothing_is_confirmed(fetching: Fetching) -> None:
    fetcher, table, (standby,) = fetching
    assert isinstance(standby, MayLag)
    for _ in range(3):
        fetcher.round()
    assert table.cells.control[HEARTBEAT] == 0
    assert table.cells.control[AWAY] == 0  # it answers
    assert set(standby.asked) == {1}


def test_cells_are_confirmed_as_of_the_proved_instant_which_never_goes_back(
    fetching: Fetching,
) -> None:
    fetcher, table, (standby,) = fetching
    for proved_at, expected in ((5, 5), (9, 9), (0, 9), (7, 9), (12, 12)):
        standby.proved_at = proved_at
        fetcher.round()
        assert table.cells.control[HEARTBEAT] == expected


def test_what_is_proved_is_the_revision_of_the_cells(env: Environment, fetching: Fetching) -> None:
    fetcher, _, (standby,) = fetching
    fetcher.round()
    write_voxels(env.store, block((1, 1, 1), (2, 2, 2)), "more")
    fetcher.round()
    assert standby.asked[0] == 1
    assert standby.asked[-1] == fetcher.residency.revision == 2


def test_answers_of_the_database_itself_confirm_as_of_the_rounds_begin(fetching: Fetching) -> None:
    fetcher, table, (standby,) = fetching
    standby.proved_at = None
    fetcher.round()
    assert table.cells.control[HEARTBEAT] > 0


def test_a_store_that_can_prove_nothing_is_closed_and_not_fetched_from(env: Environment) -> None:
    opened: list[Standby] = []

    def wrap(store: Store) -> Store:
        opened.append(Standby(store))
        opened[-1].failure = hapticdb.StaleError("behind: wait")
        made: Any = opened[-1]
        return made  # type: ignore[no-any-return]

    with CellTable.create(LEAST_BUDGET) as table:
        request = FetchRequest(env.url, table.descriptor, table.n_slots, env.grid, wrap=wrap)
        with pytest.raises(hapticdb.StaleError):
            Fetcher(request)
    assert opened[0].is_closed
