"""Statement costs at a start: stored, measured on a near database, or all taken as equal."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hapticdb import Environment, user_cache
from hapticdb.paper.cost_model import CostModel
from hapticdb.resident import source as module
from hapticdb.resident.residency import Residency
from hapticdb.resident.source import FAR, ROUND_TRIPS, costs_at_start
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.store.base import Store
from session.troubled import troubled
from session.worlds import make, move, scatter

MEASURED = CostModel(*range(1, 6))
ELSEWHERE = "a machine without kept figures"


class Line:
    """A connection with a latency in seconds, and a clock that only its round trips move."""

    def __init__(self, latency: float) -> None:
        self.latency = latency
        self.now, self.trips = 0.0, 0

    def travel(self, seconds: float) -> None:
        self.now += seconds
        self.trips += 1

    def to(self, env: Environment) -> Store:
        return troubled(env.store, latency=self.latency, wait=self.travel)


@pytest.fixture
def env(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Environment]:
    monkeypatch.setattr(module, "machine_name", lambda: ELSEWHERE)
    monkeypatch.setattr(user_cache, "cache_folder", lambda: tmp_path)
    with make(tmp_path) as made:
        scatter(made, n_objects=1, n_voxels=500)
        yield made


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[Store]:
    """The stores that were calibrated during a test."""
    seen: list[Store] = []

    def calibrate(store: Store) -> CostModel:
        seen.append(store)
        return MEASURED

    monkeypatch.setattr(module, "calibrate", calibrate)
    return seen


def write(env: Environment) -> None:
    """Give the object another voxel: another revision."""
    move(env.store, env.objects()[0].id, np.array([[1, 2, 3]]))


def test_costs_at_start_near_database_measured(env: Environment, measured: list[Store]) -> None:
    """One slow answer does not make it far."""
    line = Line(FAR / 2)
    assert costs_at_start(line.to(env), lambda: line.now) == MEASURED
    write(env)
    readings = iter([0.0, *[1.0] * (2 * ROUND_TRIPS - 1)])
    assert costs_at_start(env.store, lambda: next(readings)) == MEASURED
    assert len(measured) == 2


def test_costs_at_start_measured_once_per_revision(env: Environment, measured: list[Store]) -> None:
    far = Line(10.0)
    for n_measured in (1, 2):
        assert costs_at_start(env.store, time.monotonic) == MEASURED
        assert costs_at_start(far.to(env), lambda: far.now) == MEASURED
        assert len(measured) == n_measured
        write(env)


def test_costs_at_start_stored(env: Environment, measured: list[Store]) -> None:
    env.store.save_costs(ELSEWHERE, MEASURED.figures())
    line = Line(1.0)
    assert costs_at_start(line.to(env), lambda: line.now) == MEASURED
    assert (measured, line.trips) == ([], 1)


def test_costs_at_start_far_database_few_round_trips(env: Environment) -> None:
    """At 150 ms a round trip, the hundreds of round trips of a calibration took minutes."""
    line = Line(0.15)
    with CellTable.create(LEAST_BUDGET) as table:
        Residency(line.to(env), table, clock=lambda: line.now)
    assert ROUND_TRIPS < line.trips <= ROUND_TRIPS + 6


@pytest.mark.usefixtures("env")
def test_costs_at_start_empty_environment(tmp_path: Path, measured: list[Store]) -> None:
    (tmp_path / "empty").mkdir()
    with make(tmp_path / "empty") as empty, CellTable.create(LEAST_BUDGET) as table:
        Residency(empty.store, table)
    assert measured == []
