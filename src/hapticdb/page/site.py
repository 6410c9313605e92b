"""What all browsers of one page share: the environment's objects, tools, sessions, and a clock."""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.page import tools
from hapticdb.page.connection import PageConnection, PageRequest
from hapticdb.page.database import DatabaseThread
from hapticdb.page.editing import Edits
from hapticdb.page.scene.surroundings import set_first_view
from hapticdb.page.scene.view import SceneView
from hapticdb.page.wording import error_text
from hapticdb.session.attached import AttachedHost

if TYPE_CHECKING:
    from viser import ViserServer

LOG = logging.getLogger("hapticdb.page")
Floats = NDArray[np.float64]

TICKS = 30.0
"""Updates of tools and arrows, a second. Larger: smoother to look at, and more of a core for each
browser."""
WORKERS = 4
"""Threads that begin sessions, so that a slow one delays no other browser much."""


class _Updated(Protocol):
    """What a site asks of each browser, which imports this module."""

    def tick(self, now: float) -> None:
        """Show what is new; called `TICKS` times a second, with seconds of a clock."""

    def objects_changed(self) -> None:
        """Show the objects as they are now."""

    def close(self) -> None:
        """End what the browser shows and does."""


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """Where everything happens: the box of all objects (2, 3), metres, and which way is up.

    up, toward : unit vectors, the second level and towards the first eye; has_distances : whether
    forces come from distances to surfaces.
    """

    bounds: Floats
    up: Floats
    toward: Floats
    voxel_size: float
    has_distances: bool

    @classmethod
    def of(cls, view: SceneView) -> "SceneFacts":
        """SceneFacts of a view's objects; an empty environment has the box of its grid."""
        box, objects = view.contents.box(), view.objects.values()
        bounds = view.grid.bounds if box is None else box
        toward = np.eye(3)[(view.up + 2) % 3]
        has_distances = bool(objects) and all(obj.has_distances for obj in objects)
        return cls(bounds, np.eye(3)[view.up], toward, view.grid.voxel_size, has_distances)

    @property
    def diagonal(self) -> float:
        """Diagonal of the box, metres."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0])) or 1.0

    def start(self, radius: float, number: int) -> Floats:
        """Pose of `tools.start_pose`, free in coarse voxels, too."""
        radius = max(radius, tools.LEAST_VOXELS * self.voxel_size)
        return tools.start_pose(self.bounds, self.up, self.toward, radius, number)

    def reach(self, radius: float) -> float:
        """Distance from the box's middle within which the first tool starts, metres."""
        away = self.start(radius, 0)[:3, 3] - self.bounds.mean(axis=0)
        return float(np.linalg.norm(away)) + radius


@dataclass(eq=False)
class Site:
    """What all browsers share: viser's server, the host of sessions, and what the page is of."""

    server: "ViserServer"
    host: AttachedHost
    request: PageRequest
    connection: PageConnection
    browsers: dict[int, _Updated] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._numbers: set[int] = set()
        self._is_ending = threading.Event()
        request = self.request
        self.url = request.urls["viewer"]
        self.title = request.title or "hapticdb"
        self.recordings = None if request.recordings is None else Path(request.recordings)
        self.edits: Edits | None = None
        self.workers = ThreadPoolExecutor(WORKERS, thread_name_prefix="page-worker")
        self.sweeping = ThreadPoolExecutor(1, thread_name_prefix="page-sweep")
        if "editor" in request.urls:
            self.edits = Edits(request.urls["editor"])
        self.view = SceneView(self.server, self.url)
        self.objects = self.view.objects
        self.facts = facts = SceneFacts.of(self.view)
        self.database = DatabaseThread(self.url)
        self.is_coupled = not request.is_direct and all(
            obj.has_distances for obj in self.objects.values()
        )
        self.tools = [
            *tools.from_files(request.tools, facts.voxel_size, has_distances=facts.has_distances),
            *tools.built_in(facts.diagonal, facts.voxel_size, has_distances=facts.has_distances),
        ]
        set_first_view(self.server, facts.bounds, self.view.up, facts.reach(self.tools[0].radius))
        self._clock = threading.Thread(target=self._tick, name="page-clock", daemon=True)
        self.view.on_edit = self._learn

    def begin(self) -> None:
        """Start the clock that updates all browsers."""
        self._clock.start()

    def close(self) -> None:
        """End all sessions, the clock, and the database's thread."""
        self._is_ending.set()
        if self._clock.is_alive():
            self._clock.join(5.0)
        for client in list(self.browsers):
            self.leave(client)
        self.sweeping.shutdown(cancel_futures=True)
        self.workers.shutdown(cancel_futures=True)
        self.view.close()
        self.database.close()
        if self.edits is not None:
            self.edits.close()

    def take_number(self) -> int:
        """Return the smallest number that no browser has: it decides a tool's colour and place."""
        with self._lock:
            number = next(n for n in range(len(self._numbers) + 1) if n not in self._numbers)
            self._numbers.add(number)
            return number

    def free_number(self, number: int) -> None:
        """Let another browser have a number."""
        with self._lock:
            self._numbers.discard(number)

    def leave(self, client: int) -> None:
        """End what a client of viser shows and does; again it does nothing."""
        browser = self.browsers.pop(client, None)
        if browser is not None:
            try:
                browser.close()
            except Exception:
                LOG.exception("a browser did not end well")

    def everyone(self, act: Callable[[_Updated], None]) -> None:
        """Do something for each browser; one that fails does not stop the others."""
        for browser in list(self.browsers.values()):
            try:
                act(browser)
            except Exception:
                LOG.exception("a browser's update failed")

    def error_text(self, error: BaseException) -> str:
        """Words of an error as any browser may read them; see `wording.error_text`."""
        request = self.request
        files = [obj.link for obj in self.objects.values()] + list(request.tools)
        folders = {file.rpartition("/")[0] for file in files}
        if request.recordings is not None:
            folders.add(request.recordings)
        return error_text(error, request.urls.values(), folders)

    def _learn(self) -> None:
        """Objects have changed: somebody has edited the environment."""
        self.objects = self.view.objects
        self.everyone(lambda browser: browser.objects_changed())

    def _tick(self) -> None:
        """Update all browsers `TICKS` times a second; a late tick is not made up for."""
        while not self._is_ending.is_set():
            begun = time.monotonic()
            self.everyone(lambda browser: browser.tick(begun))  # noqa: B023 - called at once
            left = 1.0 / TICKS - (time.monotonic() - begun)
            self._is_ending.wait(max(left, 0.002))


def checked_file(folder: Path | None, name: str) -> Path:
    """Path in the operator's folder; UsageError without one, or if the name leads out."""
    if folder is None:
        raise UsageError("nothing is recorded here: the operator gave no folder (--recordings)")
    if not name or name != Path(name).name or name.startswith("."):
        raise UsageError("a recording has a name without a folder")
    return folder / name
