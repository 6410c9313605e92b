"""One browser: its session, object filter and scene."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import ClientHandle, TransformControlsEvent

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.page import checks, colours
from hapticdb.page.connection import Visitor
from hapticdb.page.drawing import HandDrawing, add_tool, put_at
from hapticdb.page.edits import PersonsEdits
from hapticdb.page.scene.browser_scene import BrowserScene
from hapticdb.page.site import Site
from hapticdb.page.tools import PageTool
from hapticdb.page.wording import plain_name
from hapticdb.poses import pose_of_row, row_of_pose
from hapticdb.session.coupling import Coupling
from hapticdb.session.hosted import HostedSession
from hapticdb.store.base import Object

LOG = logging.getLogger("hapticdb.page")
Floats = NDArray[np.float64]
Event = Any
"""Event of a viser callback."""

CAP = 7.0
"""Force cap of a hand in a browser, N, as of scripted hands; length of the longest arrow."""
LEAST_SEEN = 1e-4
"""Least displacement drawn, as a share of the scene's diagonal, and of a quaternion's entries."""
LEAST_SHOWN = 0.01
"""Least radius of a view, as a share of the scene's diagonal."""


class Browser:
    """Session, object filter and scene of one browser.

    Callbacks run in viser's threads, `tick` in the page's clock, and sessions start and end in
    worker threads of the site, one at a time (`_beginning`). `_swapping` guards the exchange of the
    session; it is released before any call to the host, so no thread waits for the host under it.
    `close` frees the browser's number.
    """

    touch: Any
    parts: Any
    record: Any
    """Tabs of `TabbedBrowser`, whose modules import this one."""

    def __init__(self, site: Site, client: ClientHandle, visitor: Visitor, number: int) -> None:
        self.site, self.client, self.visitor = site, client, visitor
        self.number = number
        self.colour = colours.of_tool(self.number)
        up = site.view.up
        self.scene = BrowserScene(client, site.view.contents, up, float(site.facts.bounds[0, up]))
        self.chosen: tuple[int, ...] = ()
        self.dragged_part: int | None = None
        self.tool: PageTool = site.tools[0]
        self.stiffness = 1000.0
        self.scale = site.facts.diagonal  # at first a metre of the hand is all of the scene
        self.session: HostedSession | None = None
        self._excluded_ids: list[int] = []
        self.hand = self._start()
        self.has_moved = False
        """Whether the person has moved the hand."""
        self.history: deque[tuple[float, float, float]] = deque(maxlen=300)  # ten seconds
        self.works: list[Any] = []
        """Long jobs of the panels, `panels.jobs.PanelJob`."""
        self._begun: float | None = None
        self._keeps_tool: bool | None = None  # of the requested session; None: no request
        self._over: list[HostedSession] = []  # detached, to end
        self._beginning, self._swapping = threading.Lock(), threading.Lock()
        self._zeroing = threading.Lock()
        self._is_closed = False
        self._shared: list[Any] = []
        self._shown = np.full(7, np.inf)
        self._plumbed_at = -np.inf
        middle = site.facts.bounds.mean(axis=0)
        self.drawing = HandDrawing(client, site.facts.diagonal, middle, CAP)
        self.drawing.gizmo.on_update(self._moved)

    def guarded(self, role: str, act: Callable[[Event], None]) -> Callable[[Event], None]:
        """Wrap a callback with a check of the role; errors are reported to this browser alone."""

        def call(event: Event) -> None:
            if self._is_closed:
                return
            if not self.visitor.may(role):
                self.notify(
                    "Not allowed", f"this takes the role {role}; yours is {self.visitor.role}"
                )
                return
            try:
                act(event)
            except Exception as error:
                if not isinstance(error, HapticDBError):
                    if self.has_gone:  # viser raises for a client without connection
                        LOG.info("a callback of a browser that has gone failed: %r", error)
                        return
                    LOG.exception("a callback of the page failed")
                self.failed(error)

        return call

    @property
    def has_gone(self) -> bool:
        """Whether the connection is lost; viser's disconnect event may come later."""
        return self.client.client_id not in self.site.server.get_clients()

    def notify(self, title: str, text: str, *, is_good: bool = False) -> None:
        """Show a notification in this browser alone."""
        if not self._is_closed:
            self.client.add_notification(
                title, plain_name(text), auto_close_seconds=8.0, color="teal" if is_good else "red"
            )

    def edit(
        self, job: Callable[[PersonsEdits], str], then: Callable[[], None] = lambda: None
    ) -> None:
        """Queue an edit of this person, if the page has editors; its words are shown."""

        def done(said: str) -> None:
            self.notify("Done", said, is_good=True)
            then()

        if self.site.edits is not None:
            self.site.edits.submit(self.client.client_id, job, done, self.failed)

    def failed(self, error: Exception) -> None:
        """Show an error without the server's paths and addresses."""
        self.notify("Not done", self.site.error_text(error))

    async def _moved(self, event: TransformControlsEvent) -> None:
        """Move the hand; async, on viser's event loop, so that events stay in order."""

        def act(event: Event) -> None:
            self.move_hand(checks.row_of(event.target.position, event.target.wxyz))
            if event.phase == "end":
                self.touch.show_hand()

        self.guarded("toucher", act)(event)

    def move_hand(self, pose: Floats) -> None:
        """Move the hand to a pose (7,), metres."""
        self.hand, self.has_moved = pose, True
        self.drawing.words.visible = False
        if (session := self._running) is not None:
            session.move(pose)

    def use_tool(self, tool: PageTool, pose: Floats | None = None) -> None:
        """Use another tool, from a pose (7,), by default the start pose."""
        with self._zeroing:  # a second click calls this in another thread
            self.tool = tool
            self.hand = self._start() if pose is None else pose
            self.drawing.show_ghost(tool, self.colour, self.hand)
            self.begin_anew(keeps_tool=False)
            self.touch.show_tool()
            self.parts.show_tool()
            self.touch.show_hand()

    def put_back(self) -> None:
        """Put the dragged part back and use the first tool; without a dragged part, do nothing."""
        dragged, self.dragged_part = self.dragged_part, None
        if dragged is not None:
            self.scene.show((dragged,))
            self.use_tool(self.site.tools[0])

    @property
    def excluded_ids(self) -> list[int]:
        """Ids of the objects without collision here: hidden objects and the dragged part."""
        dragged = () if self.dragged_part is None else (self.dragged_part,)
        return sorted({*self.scene.hidden, *dragged} & self.site.objects.keys())

    def chosen_objects(self) -> list[Object]:
        """Chosen objects that still exist."""
        objects = self.site.objects
        return [objects[i] for i in self.chosen if i in objects]

    def only_chosen(self) -> Object:
        """The chosen object; UsageError unless exactly one is chosen."""
        chosen = self.chosen_objects()
        if len(chosen) != 1:
            raise UsageError("choose one part first: click it, or take it from the list")
        return chosen[0]

    def filter_changed(self) -> None:
        """Restart the session if the set of colliding objects has changed."""
        if self.excluded_ids != self._excluded_ids:
            self.begin_anew()

    def begin_anew(self, *, keeps_tool: bool = True) -> None:
        """Request a new session from a worker; it starts at the tool's pose, or at the hand's."""
        if not self.visitor.may("toucher") or self._is_closed:
            return
        with self._swapping:
            # requests merge: a new start of one waiting request must survive the other
            self._keeps_tool = keeps_tool and self._keeps_tool is not False
        self.site.workers.submit(self._begin_wanted)

    def _begin_wanted(self) -> None:
        """Start sessions while one is requested, unless another worker is doing so."""
        # non-blocking: a request that comes while another worker begins is taken in its next turn
        while self._keeps_tool is not None and self._beginning.acquire(blocking=False):
            try:
                self._begin()
            except HapticDBError as error:
                self.failed(error)
            except Exception:
                LOG.exception("a session could not begin")
                self.notify("No tool", "the session could not begin; the operator's log says why")
            finally:
                self._beginning.release()

    def _begin(self) -> None:
        """End the session, and start the requested one."""
        with self._swapping:
            # taken before the work: a request during it starts another session
            keeps_tool, self._keeps_tool = self._keeps_tool, None
        if keeps_tool is None or self._is_closed:
            return
        # the old session ends first: its slot and cells may be needed
        tool = self._leave_session()
        self._end_sessions()
        start = tool if keeps_tool and tool is not None else self.hand
        # before `begin`: a change meanwhile differs from it and asks again
        self._excluded_ids = self.excluded_ids
        with ExitStack() as undo:
            undo.callback(self.drawing.rest)
            undo.callback(self._unshare)
            session = self.site.host.begin(
                self.tool.shell, pose_of_row(start[:3], start[3:]), exclude=self._excluded_ids,
                coupling=self._coupling(), scale=self.scale,
            )  # fmt: skip
            # the browser may close during `begin`: then nothing else ends the session
            undo.callback(session.end)
            session.move(self.hand)
            self._share()
            with self._swapping:
                if self._is_closed:
                    return
                # published last, under the lock: `close` either sees it or comes first
                self.session = session
                undo.pop_all()

    def _leave_session(self) -> Floats | None:
        """Detach the session; pose (7,) of its tool, None without a frame."""
        session = self.session
        if session is None or not self._give_up(session):
            return None
        self.record.session_ended()
        try:
            frame = session.latest()
        except HapticDBError:  # it is over
            return None
        return None if frame is None else np.array(frame["tool"][0])

    def _give_up(self, session: HostedSession) -> bool:
        """Detach the session for `_end_sessions`; False if it is detached already."""
        with self._swapping:
            # tick and worker may both find it over: one of them detaches it
            if self.session is not session:
                return False
            self.session = None
            self._over.append(session)
            return True

    def _end_sessions(self) -> None:
        """End the detached sessions, and report the lost frames of their recordings."""
        with self._swapping:
            # taken under the lock, ended outside: `end` waits for the host
            over, self._over = self._over, []
        for session in over:
            try:
                session.end()
            except Exception:  # every other part of it has ended
                LOG.exception("a session did not end well")
            self._report_lost_frames(session)

    def _report_lost_frames(self, session: HostedSession) -> None:
        n_lost, session.lost_frames = session.lost_frames, 0
        if n_lost:
            self.notify(
                "Recording incomplete", f"{n_lost:,} frames were lost: the server was too busy"
            )

    def matrix_of_tool(self) -> Floats:
        """Pose (4, 4) of the tool, metres; of the hand without a session."""
        session = self._running
        frame = None if session is None else session.latest()
        row = self.hand if frame is None else np.array(frame["tool"][0])
        return pose_of_row(row[:3], row[3:])

    @property
    def _running(self) -> HostedSession | None:
        session = self.session
        return None if session is None or session.is_over else session

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the virtual coupling, N/m."""
        self.stiffness = stiffness
        if (session := self._running) is not None:
            session.set_coupling(self._coupling())

    def _coupling(self) -> Coupling | None:
        return Coupling(stiffness=self.stiffness) if self.site.is_coupled else None

    def _start(self) -> Floats:
        return row_of_pose(self.site.facts.start(self.tool.radius, self.number))

    def _share(self) -> None:
        """Show the tool in every browser, with the person's name in all others."""
        self._unshare()
        scene = self.site.server.scene
        name = f"/people/{self.number}"
        node = add_tool(scene, name, self.tool, self.colour, None)
        label = scene.add_label(
            f"{name}/name", self.visitor.name, position=(0.0, 0.0, 1.25 * self.tool.radius),
            anchor="bottom-center",
        )  # fmt: skip
        unseen = self.client.scene.add_frame(f"{name}/name", show_axes=False, visible=False)
        put_at(node, self.hand)
        self._shown = np.full(7, np.inf)
        self._shared = [unseen, label, node]

    def _unshare(self) -> None:
        # swapped first: the clock's thread must not move removed nodes
        shared, self._shared = self._shared, []
        for node in shared:
            node.remove()

    def tick(self, now: float) -> None:
        """Show the newest frame of the session; called `site.TICKS` times a second."""
        session = self.session
        if session is not None and session.is_over:
            # a lost session is noticed by one tick alone, and begun again once
            if self._give_up(session):
                self.drawing.rest()
                self.record.session_ended()
                self.notify("Tool lost", "its process ended; it begins again")
                self.begin_anew()
            return
        if session is not None and session.lost_frames:
            self._report_lost_frames(session)
        frame = None if session is None else session.latest()
        if session is None or frame is None:
            return
        one = frame[0]
        tool, wrench = np.array(one["tool"]), np.array(one["applied"])
        shared = self._shared
        if shared and has_moved(tool, self._shown, self.site.facts.diagonal):
            put_at(shared[-1], tool)
            self._shown = tool
        points, _ = session.contacts()
        touched = [self.site.objects[i] for i in session.touched() if i in self.site.objects]
        self.drawing.show(tool, self.hand, wrench)
        self._plumb(now)
        self.drawing.show_contacts(
            points if one["contacts"] else points[:0], colours.of_contacts(points, touched)
        )
        self._begun = now if self._begun is None else self._begun
        force, torque = np.linalg.norm(wrench.reshape(2, 3), axis=1).tolist()
        self.history.append((now - self._begun, force, torque))
        self.touch.show(one, wrench, touched, now)

    def _plumb(self, now: float) -> None:
        """Draw the plumb line from the hand to the first surface below it, ten times a second."""
        if now - self._plumbed_at < 0.1:
            return
        self._plumbed_at = now
        hit = self.scene.pick(self.hand[:3], -self.site.facts.up)
        self.drawing.plumb(self.hand[:3], None if hit is None else hit.point)

    def objects_changed(self) -> None:
        """Drop removed objects from the selection; called in the follower's thread."""
        present = self.site.objects.keys()
        self.chosen = tuple(i for i in self.chosen if i in present)
        if self.dragged_part is not None and self.dragged_part not in present:
            self.dragged_part = None
        self.scene.shade()
        if not set(self.excluded_ids) <= set(self._excluded_ids):  # a hidden object has come back
            self.begin_anew()

    def close(self) -> None:
        """End the session and remove the tool from every view."""
        # first: callbacks and workers that begin now turn back
        self._is_closed = True
        self.site.view.contents.leave(self.client.client_id)
        if self.site.edits is not None:
            self.site.edits.forget(self.client.client_id)
        self._unshare()
        self.site.free_number(self.number)
        with self._swapping:
            session, self.session = self.session, None
            self._over += [] if session is None else [session]
        self._end_sessions()


def put(widget: Any, value: object) -> None:  # noqa: ANN401 - viser's types hide the setter
    """Set a widget's value; its callbacks receive an event with client None."""
    widget.value = value


def has_moved(pose: Floats, before: Floats, diagonal: float) -> bool:
    """Whether two poses (7,) differ visibly in a scene of a diagonal, metres."""
    change = np.abs(pose - before)
    return bool((change[:3] > LEAST_SEEN * diagonal).any() or (change[3:] > LEAST_SEEN).any())
