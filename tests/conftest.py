"""What tests share: the folder of real CAD files, a shell, and the header of the run."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import apsw
import numba
import numpy as np
import pytest

import children
import draws
from banded import write_points
from command_line import made, run, scene  # noqa: F401 - fixtures
from hapticdb import Environment, PointShell
from hapticdb.kernels import _machine_code, _sets
from hapticdb.mesh import MeshFile, reader
from hapticdb.mesh.parse import parse
from hapticdb.pointshell.shell import fibonacci_sphere
from servers import FOUND, admin, database, named, place  # noqa: F401 - fixtures
from session.sessions import floor_points, floored
from session.worlds import make
from voxels import KINDS

NEWEST = {"cli", "house"}
"""Rooms tested on the newest PostgreSQL alone: what is said, not what a server is asked."""
OLDER = {"test_contract_postgres.py", "test_partitions.py"}
"""Modules tested on every PostgreSQL that is found; the others only with --every-step."""
QUICK_KINDS = {"brick-z", "voxel-lexicographic"}
"""Layout and curve of the contract's quick tests on other engines than SQLite, which has all."""


def pytest_addoption(parser: pytest.Parser) -> None:
    draws.add_options(parser)


def pytest_configure(config: pytest.Config) -> None:
    draws.choose(config)
    of_a_worker: dict[str, str] | None = getattr(config, "workerinput", None)
    if of_a_worker is None:  # once, before the processes that run tests start
        children.begin_run()
        for group in _machine_code.GROUPS:
            _sets.fitting_set(group)
    else:
        children.begin_run(Path(of_a_worker["shared"]))


def pytest_configure_node(node: Any) -> None:  # noqa: ANN401 - xdist has no types
    """Tell a process that runs tests which folder and which seed the run shares."""
    draws.tell(node.workerinput)
    node.workerinput["shared"] = str(children.shared_folder())


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out, or for the long tests, what repeats a test on another version or engine."""
    older = set(map(named, FOUND[1:]))
    kept: list[pytest.Item] = []
    excluded: list[pytest.Item] = []
    for item in items:
        name, words = item.path.name, getattr(getattr(item, "callspec", None), "id", "")
        is_older = not older.isdisjoint(words.split("-"))
        is_wanted = name in OLDER or draws.is_every()
        is_excluded = is_older and (item.path.parent.name in NEWEST or not is_wanted)
        kinds = {"-".join(kind) for kind in KINDS}
        is_other_kind = any(kind in words for kind in kinds - QUICK_KINDS)
        if name == "test_partitions.py" and is_other_kind and not draws.is_every():
            is_excluded = True
        (excluded if is_excluded else kept).append(item)
        is_other = name.startswith("test_contract_") and name != "test_contract_sqlite.py"
        if is_older or (is_other and is_other_kind):
            item.add_marker(pytest.mark.long)
    config.hook.pytest_deselected(items=excluded)
    items[:] = kept


def real_folder() -> Path | None:
    """Folder of real CAD files, from the environment variable HAPTICDB_TEST_DATA."""
    named = os.environ.get("HAPTICDB_TEST_DATA")
    return Path(named).resolve() if named else None


def pytest_report_header() -> list[str]:
    folder = real_folder()
    if folder is not None and not (folder / "SOURCES.md").is_file():
        pytest.exit(f"HAPTICDB_TEST_DATA={folder} holds no SOURCES.md: give the right folder")
    where = f"real CAD from {folder}" if folder else "the sample stands in for real CAD"
    jit = "off" if numba.config.DISABLE_JIT else "on"
    servers = ", ".join(map(named, FOUND))
    return [
        f"hapticdb: {where}; SQLite {apsw.sqlite_lib_version()}, {servers}, JIT {jit}",
        draws.header(),
    ]


@pytest.fixture(autouse=True)
def _signals_are_left_as_they_were() -> Iterator[None]:
    """Otherwise every process that a later test starts would ignore these signals, too."""
    numbers = signal.SIGINT, signal.SIGTERM
    before = list(map(signal.getsignal, numbers))
    yield
    after = list(map(signal.getsignal, numbers))
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
    assert after == before


@pytest.fixture(scope="module", autouse=True)
def _files_are_parsed_here() -> Iterator[None]:
    """Otherwise each file costs a child process, 0.15 s; `mesh` tests that child."""

    def ask(request: dict[str, Any], _: float) -> MeshFile:
        return parse(Path(request["path"]), request["metres"], request["chord"])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader, "_run_child", ask)
        yield


@pytest.fixture(scope="session")
def test_data() -> Path | None:
    return real_folder()


@pytest.fixture(scope="session")
def real_files(test_data: Path | None) -> Path:
    if test_data is None:
        pytest.skip("HAPTICDB_TEST_DATA names no folder: there are no real files to read")
    return test_data


@pytest.fixture(scope="session")
def sphere() -> PointShell:
    """300 points on a sphere of 12 mm about the tool's origin, normals inward."""
    out = fibonacci_sphere(300)
    return PointShell(points=out * 0.012, normals=-out, center=np.zeros(3), is_closed=True)


@pytest.fixture(scope="module")
def voxel_floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """A floor of voxels with its top at z = 0, on SQLite."""
    with floored(make(tmp_path_factory.mktemp("voxels"), bits=6)) as env:
        yield env


@pytest.fixture(scope="module")
def distance_floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """A floor with distances, 1 mm below z = 0, on SQLite."""
    with make(tmp_path_factory.mktemp("distances"), bits=6) as env:
        write_points(env.store, floor_points(31.5), "floor")
        yield env
