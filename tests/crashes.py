"""Servers that crash, and imports and edits that a crash interrupts, for tests of recovery."""

import contextlib
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from assemblies import Mesh, ball, placement, write_obj
from children import joined
from hapticdb import Environment, GridOptions, ImportOptions, PointShell
from hapticdb.ingest.files import ImportProgress
from hapticdb.paper.strategies import Strategy
from hapticdb.store.base import Layout
from hapticdb.store.postgres.connecting import server_connection
from postgres_servers import Binaries, Server
from servers import FOUND, kill, named
from validity import Contents, contents, valid_contents

N_PARTS = 30
SOON_S = 0.2
"""Seconds that a client waits for a server that does not come back."""


def options(layout: Layout) -> ImportOptions:
    return ImportOptions(grid=GridOptions(bits=7), layout=layout, jobs=2)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of thirty balls, each of about 1,000 voxels."""
    rng = np.random.default_rng(3)
    parts: dict[str, Mesh] = {}
    for n in range(N_PARTS):
        parts[f"ball {n}"] = ball(rng.uniform(-0.3, 0.3, 3), 0.07, 16)
    return write_obj(tmp_path_factory.mktemp("balls") / "balls.obj", parts)


@pytest.fixture(scope="module")
def undisturbed(file: Path) -> dict[Layout, Contents]:
    """Contents after an import without a crash, made on SQLite: the rows are the same."""
    found: dict[Layout, Contents] = {}
    for layout in ("voxel", "brick"):
        database = file.with_name(f"{layout}.db")
        hapticdb.import_files(database, [file], options(layout))
        found[layout] = valid_contents(str(database))
    return found


@pytest.fixture(scope="module", params=FOUND, ids=named)
def template(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Binaries]:
    """The folder of a server that was set up and never started."""
    folder = tmp_path_factory.mktemp("template")
    Server(folder, request.param, {})
    return folder, request.param


@contextlib.contextmanager
def running(
    template: tuple[Path, Binaries], settings: Mapping[str, str] | None = None
) -> Iterator[Server]:
    place = Path(tempfile.mkdtemp(prefix="crash-")).resolve()
    shutil.copytree(template[0], place / "server", symlinks=True)
    made = Server(place / "server", template[1], settings or {})
    made.start()
    try:
        yield made
    finally:
        kill(made)
        shutil.rmtree(place)


@pytest.fixture
def server(template: tuple[Path, Binaries]) -> Iterator[Server]:
    with running(template) as made:
        yield made


@pytest.fixture(scope="module")
def crashing(template: tuple[Path, Binaries], file: Path) -> Iterator[tuple[Server, Environment]]:
    """A server that several tests crash, and an environment on it."""
    with running(template) as made, small(made.conninfo(), file) as env:
        yield made, env


@pytest.fixture
def url(server: Server) -> str:
    return server.conninfo()


@pytest.fixture
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_connection, "RECONNECT_SECONDS", SOON_S)


def moments(seed: int) -> list[tuple[int, float]]:
    """Three moments of an import: the number of finished parts, and seconds into the next."""
    rng = np.random.default_rng(seed)
    parts = np.sort(rng.choice(np.arange(1, N_PARTS - 5, 5), 3, replace=False))
    return [(n, float(rng.uniform(0, 0.008))) for n in parts.tolist()]


class Killer:
    """Calls a function during an import, between a part and the fourth part after it."""

    def __init__(self, n_parts: int, delay: float, event: Callable[[], object]) -> None:
        self._n_parts = n_parts
        self._timer = threading.Timer(delay, event)

    def __call__(self, progress: ImportProgress) -> None:
        """Take the import's progress; call the function when its part is reached."""
        if progress.parts_done == self._n_parts:
            self._timer.start()
        elif progress.parts_done == self._n_parts + 4:
            self.joined()

    def joined(self) -> None:
        """Wait until the function has returned, if it was called."""
        if self._timer.ident is not None:
            joined(self._timer)


def crash(server: Server) -> None:
    """Kill the server and start it again, so that clients that wait for it can go on."""
    kill(server)
    server.start()


class After:
    """Calls a function once, when a method has returned for the given number of times."""

    def __init__(
        self,
        patch: pytest.MonkeyPatch,
        owner: type[Any],
        name: str,
        event: Callable[[], object],
        n_calls: int = 1,
    ) -> None:
        self.calls_left = n_calls
        method = getattr(owner, name)

        def called(*args: Any, **keywords: Any) -> Any:  # noqa: ANN401 - any method
            result = method(*args, **keywords)
            self.calls_left -= 1
            if self.calls_left == 0:
                event()
            return result

        patch.setattr(owner, name, called)


def small(url: str, file: Path) -> Environment:
    hapticdb.import_files(url, [file], options("brick"))
    return hapticdb.open(url)


PLACE = placement(0.02, 0.01, -0.03)
STEPS = ("_next_revision", "_take", "_put", "_log")
"""Steps of a write, in their order: methods of `ServerTables`."""
Edit = Callable[[Environment], object]
EDITS: list[tuple[str, Edit]] = [
    ("move", lambda env: env.move(7, PLACE)),
    ("remove", lambda env: env.remove(8)),
]


@pytest.fixture(scope="module")
def edited(file: Path, undisturbed: dict[Layout, Contents]) -> list[Contents]:
    """Contents of the environment after each edit, without a crash."""
    assert undisturbed
    database = file.with_name("edited.db")
    shutil.copy(file.with_name("brick.db"), database)
    found: list[Contents] = []
    with hapticdb.open(database) as env:
        for _, edit in EDITS:
            edit(env)
            found.append(contents(env))
    return found


def steps_of(name: str) -> list[str]:
    return [step for step in STEPS if step != "_put" or name == "move"]


def felt(
    env: Environment, shell: PointShell, pose: np.ndarray[Any, Any], strategy: Strategy = "auto"
) -> tuple[Any, ...]:
    touch = env.touch(shell, pose, strategy, law="plane")
    wrench = np.concatenate([touch.force, touch.torque]).tobytes()
    return wrench, touch.hits.tolist(), [obj.id for obj in touch.objects]
