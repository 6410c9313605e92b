"""Every experiment on small environments: the cells it returns, and that their counts are right."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from hapticdb import Environment, GridOptions, ImportOptions
from hapticdb.bench import experiments, run
from hapticdb.bench.cells import IN_THE_SERVER, ONE_STATEMENT
from hapticdb.bench.experiments import Budget
from hapticdb.bench.measure import Cell
from hapticdb.bench.run import Workload
from hapticdb.bench.subject import Subject, limited
from hapticdb.bench.workload import Task
from hapticdb.query.frame import STRATEGIES
from hapticdb.query.quantiles import QuantileVector
from hapticdb.sample import write_sample
from hapticdb.store.base import LAYOUTS, SupportsCaches
from servers import Place

TINY = Budget(
    cell_s=5.0,
    frames=12,
    tail=30,
    cold=3,
    windows=20,
    gaps=(0, 100, 100_000),
    resolutions=(10, 100, 1000),
    shells=(30, 300),
)


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("sample"), 12).car


def options(layout: str) -> ImportOptions:
    return ImportOptions(grid=GridOptions(bits=8, extent=1.6), layout=layout)  # type: ignore[arg-type]


@pytest.fixture(scope="module", params=LAYOUTS)
def env(
    request: pytest.FixtureRequest, car: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    url = tmp_path_factory.mktemp("env") / "car.db"
    hapticdb.import_files(url, [car], options(request.param))
    with hapticdb.open(url, read_only=True) as opened:
        yield opened


@pytest.fixture(scope="module")
def work(env: Environment) -> Workload:
    return run.workload_of(env, TINY)


@pytest.fixture(scope="module")
def subject(env: Environment) -> Subject:
    return Subject(env, "car", limited(env, 4 << 20), run.drop_of(env))


def by_strategy(cells: list[Cell]) -> dict[str, Cell]:
    return {cell["strategy"]: cell for cell in cells}


@pytest.mark.long
def test_figure_8_measures_every_resolution_with_its_grouping_apart(
    subject: Subject, work: Workload
) -> None:
    cells = experiments.figure_8(subject, work.slide, work.finest, TINY)
    assert [cell["resolution"] for cell in cells] == list(TINY.resolutions)
    assert all(cell["grouping_us"] > 0 for cell in cells)
    assert all(cell["strategy"] == "cbgroup" for cell in cells)


@pytest.mark.parametrize("resolution", [1, 10, 100, 500])
def test_a_coarsened_vector_is_that_of_its_resolution(env: Environment, resolution: int) -> None:
    finest = env.quantiles(1000)
    coarse = experiments.coarsened(finest, resolution)
    exact = env.quantiles(resolution)
    np.testing.assert_array_equal(coarse.bounds, exact.bounds)
    assert (coarse.resolution, coarse.n_rows) == (resolution, exact.n_rows)


def test_figure_9_reads_more_rows_in_fewer_ranges_as_maxgap_grows(
    subject: Subject, work: Workload
) -> None:
    cells = experiments.figure_9(subject, work.slide, TINY)
    gaps = [cell for cell in cells if cell["strategy"] == "maxgap"]
    assert [cell["maxgap"] for cell in gaps] == list(TINY.gaps)
    ranges, rows = ([cell[name] for cell in gaps] for name in ("ranges", "rows"))
    assert ranges == sorted(ranges, reverse=True)
    assert rows == sorted(rows)
    assert gaps[0]["false_rows"] == pytest.approx(0)
    assert {"cbgroup", "array", "auto"} < set(by_strategy(cells))
    assert by_strategy(cells)["array"]["false_rows"] == pytest.approx(0)


def test_figure_10_tells_the_density_of_each_region(subject: Subject, work: Workload) -> None:
    cells = experiments.figure_10(subject, work.slide, work.regions, TINY)
    assert {cell["region"] for cell in cells} == {"low", "middle", "high"}
    densities = {cell["region"]: cell["density"] for cell in cells}
    assert densities["low"] <= densities["middle"] <= densities["high"]
    assert len(cells) == 3 * (len(TINY.gaps) + 3)


def test_every_strategy_is_measured_over_every_task(subject: Subject, work: Workload) -> None:
    cells = experiments.strategies(subject, work.tasks, TINY)
    assert {(cell["poses"], cell["strategy"]) for cell in cells} == {
        (task.name, name) for task in work.tasks for name in STRATEGIES
    }
    by_name = by_strategy(cells)
    assert sum(by_name["auto"]["chosen"].values()) == TINY.frames
    assert by_name["points"]["rows"] == by_name["array"]["rows"]


def test_larger_shells_are_as_dense(subject: Subject) -> None:
    cells = experiments.points(subject, TINY)
    radii = {cell["points"]: cell["radius_voxels"] for cell in cells}
    assert set(radii) == set(TINY.shells)
    assert radii[300] / radii[30] == pytest.approx(10**0.5)


def test_shells_too_large_for_the_strategy_or_the_grid_are_left_out(subject: Subject) -> None:
    budget = replace(TINY, shells=(300, 3000, 10_000_000))
    cells = experiments.points(subject, budget)
    assert {cell["points"] for cell in cells} == {300, 3000}
    assert all(cell["points"] <= 1000 for cell in cells if cell["strategy"] == "points")


def test_the_tail_is_measured_over_as_many_frames_as_asked(
    subject: Subject, work: Workload
) -> None:
    cells = experiments.tail(subject, work.slide, TINY)
    assert {cell["frames"] for cell in cells} == {TINY.tail}


def test_cold_frames_are_few_and_say_so(subject: Subject, work: Workload) -> None:
    cells = run.under_conditions(subject, work, TINY, is_first=True)
    cold = [cell for cell in cells if cell["file"] == "cold"]
    assert {cell["frames"] for cell in cold} == {TINY.cold}
    assert len(cells) == 2 * len(cold)
    again = run.under_conditions(subject, work, TINY, is_first=False)
    assert {cell["file"] for cell in again} == {"cached"}


def test_a_dropped_cache_is_read_again_and_answers_the_same(
    subject: Subject, work: Workload
) -> None:
    store = subject.env.store
    assert isinstance(store, SupportsCaches)
    shell, pose = work.slide.shell, work.slide.poses[3]
    before = subject.env.touch(shell, pose)
    store.drop_caches()
    after = subject.env.touch(shell, pose)
    assert before.force.tobytes() == after.force.tobytes()
    np.testing.assert_array_equal(before.hits, after.hits)


def test_a_cache_is_named_by_what_it_holds(env: Environment) -> None:
    assert limited(env, 1 << 20) == ("1 MB" if env.size().bytes > 1 << 20 else "all cached")
    assert limited(env, 1 << 30) == "all cached"
    assert limited(env, 4 << 20) in {"4 MB", "all cached"}


@pytest.mark.long
def test_a_loop_in_the_server_finds_the_same(place: Place, car: Path) -> None:
    """The loop scans one range at a time; tested on every server and both layouts."""
    for layout in LAYOUTS:
        url = place()
        hapticdb.import_files(url, [car], options(layout))
        with hapticdb.open(url) as env:
            subject = Subject(env, "car", limited(env, 0))
            looping = subject.looping_query
            assert looping is not None
            work = run.workload_of(env, TINY)
            for pose in work.slide.poses:
                for strategy in ("cbgroup", "maxgap"):
                    one = subject.query().run(work.slide.shell, pose, strategy)
                    other = looping.run(work.slide.shell, pose, strategy)
                    assert one.wrench.tobytes() == other.wrench.tobytes()
                    np.testing.assert_array_equal(one.pairs(), other.pairs())
                    assert strategy == "cbgroup" or one.query.rows == other.query.rows
            cells = experiments.figure_9(subject, work.slide, TINY)
    assert {cell["form"] for cell in cells} == {ONE_STATEMENT, IN_THE_SERVER}


@pytest.mark.long
def test_a_file_has_no_loop_in_a_server(subject: Subject) -> None:
    assert subject.looping is None
    assert subject.looping_query is None


def test_an_empty_vector_has_one_bucket() -> None:
    empty = QuantileVector(np.zeros(2, dtype=np.int64), 0)
    assert experiments.coarsened(empty, 1).resolution == 1


def test_a_region_is_told_in_its_cells(subject: Subject, work: Workload) -> None:
    region = work.regions[2]
    task = Task("random", "sphere", work.slide.shell, region.poses, region.name, region.density)
    cell = subject.conditions(task)
    assert (cell["region"], cell["density"]) == ("high", region.density)
    assert "region" not in subject.conditions(work.slide)
