"""State shared by all browsers of a page: objects, tools, session host and clock."""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import ViserServer

from hapticdb.errors import UsageError
from hapticdb.machines.joint_path import checked_values, read_joints
from hapticdb.machines.machine import Machine
from hapticdb.machines.reader import read_machine
from hapticdb.page import tools
from hapticdb.page.connection import PageConnection, PageRequest
from hapticdb.page.database import DatabaseThread
from hapticdb.page.edits import Edits
from hapticdb.page.scene.surroundings import set_first_view
from hapticdb.page.scene.view import SceneView
from hapticdb.page.wording import error_text
from hapticdb.session.attached import AttachedHost

LOG = logging.getLogger("hapticdb.page")
Floats = NDArray[np.float64]

TICKS = 30.0
"""Frequency of the clock, Hz. Larger: smoother motion, and more CPU for each browser."""
WORKERS = 4
"""Threads for sessions: a slow start delays no other browser much."""


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """AABB of all objects, (2, 3), metres, and orientation of the scene.

    up, toward : unit vectors, upward, and horizontal towards the first eye; has_distances : whether
    forces come from distances to surfaces.
    """

    bounds: Floats
    up: Floats
    toward: Floats
    voxel_size: float
    has_distances: bool

    @classmethod
    def of(cls, view: SceneView) -> "SceneFacts":
        """Facts of a view; an empty environment has the AABB of its grid."""
        box, objects = view.contents.box(), view.objects.values()
        bounds = view.grid.bounds if box is None else box
        toward = np.eye(3)[(view.up + 2) % 3]
        has_distances = bool(objects) and all(obj.has_distances for obj in objects)
        return cls(bounds, np.eye(3)[view.up], toward, view.grid.voxel_size, has_distances)

    @property
    def diagonal(self) -> float:
        """Diagonal of the AABB, metres."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0])) or 1.0

    def start(self, radius: float, number: int) -> Floats:
        """Pose (4, 4) of `tools.start_pose`, with clearance for coarse voxels."""
        radius = max(radius, tools.LEAST_VOXELS * self.voxel_size)
        return tools.start_pose(self.bounds, self.up, self.toward, radius, number)

    def reach(self, radius: float) -> float:
        """Radius about the AABB's centre that contains the first tool at its start, metres."""
        away = self.start(radius, 0)[:3, 3] - self.bounds.mean(axis=0)
        return float(np.linalg.norm(away)) + radius


@dataclass(eq=False)
class Site:
    """State shared by all browsers; viser's server, session host, arguments of the process."""

    server: ViserServer
    host: AttachedHost
    request: PageRequest
    connection: PageConnection
    browsers: dict[int, Any] = field(default_factory=dict)
    """`TabbedBrowser`, whose module imports this one, by viser's numbers of clients."""

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
            *tools.from_files(
                request.tools,
                facts.voxel_size,
                has_distances=facts.has_distances,
                unit=request.tool_unit,
                extent=float(np.ptp(facts.bounds, axis=0).max()),
            ),
            *tools.built_in(facts.diagonal, facts.voxel_size, has_distances=facts.has_distances),
        ]
        self.machine: tuple[Machine, Floats] | None = None
        if (files := request.machine) is not None:
            machine = read_machine(files.machine, files.srdf)
            q = np.zeros((1, len(machine.driven)))
            self.machine = (
                machine,
                q if files.joints is None else read_joints(files.joints, machine),
            )
            checked_values(*self.machine)
        set_first_view(self.server, facts.bounds, self.view.up, facts.reach(self.tools[0].radius))
        self.clock = threading.Thread(target=self._tick, name="page-clock", daemon=True)
        """Updates all browsers, once it is started."""
        self.view.on_edit = self._learn

    def close(self) -> None:
        """End all sessions, the clock and all threads."""
        self._is_ending.set()
        if self.clock.is_alive():
            self.clock.join(5.0)
        for client in list(self.browsers):
            self.leave(client)
        self.sweeping.shutdown(cancel_futures=True)
        self.workers.shutdown(cancel_futures=True)
        self.view.close()
        self.database.close()
        if self.edits is not None:
            self.edits.close()

    def take_number(self) -> int:
        """Assign the smallest free number; it decides the tool's colour and start."""
        with self._lock:
            number = next(n for n in range(len(self._numbers) + 1) if n not in self._numbers)
            self._numbers.add(number)
            return number

    def free_number(self, number: int) -> None:
        """Release a number."""
        with self._lock:
            self._numbers.discard(number)

    def leave(self, client: int) -> None:
        """Close the browser of a client, once."""
        browser = self.browsers.pop(client, None)
        if browser is not None:
            try:
                browser.close()
            except Exception:
                LOG.exception("a browser did not end well")

    def everyone(self, act: Callable[[Any], None]) -> None:
        """Call a function for each browser; a failure is logged and does not affect the others."""
        for browser in list(self.browsers.values()):
            try:
                act(browser)
            except Exception:
                LOG.exception("a browser's update failed")

    def error_text(self, error: BaseException) -> str:
        """Text of an error for browsers; see `wording.error_text`."""
        request = self.request
        files = [obj.link for obj in self.objects.values()] + list(request.tools)
        files += [] if request.machine is None else [request.machine.machine]
        folders = {file.rpartition("/")[0] for file in files}
        if request.recordings is not None:
            folders.add(request.recordings)
        return error_text(error, request.urls.values(), folders)

    def _learn(self) -> None:
        """Update all browsers after a commit."""
        self.objects = self.view.objects
        self.everyone(lambda browser: browser.objects_changed())

    def _tick(self) -> None:
        """Update all browsers `TICKS` times a second; late ticks are skipped."""
        while not self._is_ending.is_set():
            begun = time.monotonic()
            self.everyone(lambda browser: browser.tick(begun))  # noqa: B023 - called at once
            left = 1.0 / TICKS - (time.monotonic() - begun)
            self._is_ending.wait(max(left, 0.002))


def checked_file(folder: Path | None, name: str) -> Path:
    """Path in the operator's folder; UsageError without a folder, or for a path outside it."""
    if folder is None:
        raise UsageError("nothing is recorded here: the operator gave no folder (--recordings)")
    if not name or name != Path(name).name or name.startswith("."):
        raise UsageError("a recording has a name without a folder")
    return folder / name
