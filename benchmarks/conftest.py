"""Scenes of the benchmarks: the paper's size when they measure, tiny when they run as tests."""

from collections.abc import Iterator

import pytest

import children
import examples
import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.poses import read_poses
from hapticdb.sample import write_sample
from hapticdb.store.base import LAYOUTS, Layout
from scene import BenchScene, is_measuring

PAPER_BITS = 11
TINY_BITS = 7
"""Bits an axis of the grid when times are measured, and when benchmarks run as tests."""


def pytest_configure() -> None:
    examples.choose()
    children.begin_run()


@pytest.fixture(scope="session", autouse=True)
def _servers_end_with_the_run(tmp_path_factory: pytest.TempPathFactory) -> None:
    children.end_servers_below(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session")
def bits(pytestconfig: pytest.Config) -> int:
    return PAPER_BITS if is_measuring(pytestconfig) else TINY_BITS


@pytest.fixture(scope="session")
def scene(bits: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[BenchScene]:
    """Sample car, extent 1.6; 300 points of the wrench; poses spread over the sample's path."""
    folder = tmp_path_factory.mktemp("bench")
    files = write_sample(folder, count=400)
    environments: dict[Layout, Environment] = {}
    for layout in LAYOUTS:
        options = hapticdb.ImportOptions(
            grid=hapticdb.GridOptions(bits=bits, extent=1.6), layout=layout, distances=False
        )
        (report,) = hapticdb.import_files(folder / f"{layout}.db", [files.car], options)
        assert report.status == "imported"
        environments[layout] = hapticdb.open(folder / f"{layout}.db", read_only=True)
    shell = PointShell.from_file(files.wrench, points=300)
    yield BenchScene(files, environments, shell, list(read_poses(files.path)))
    for env in environments.values():
        env.close()
