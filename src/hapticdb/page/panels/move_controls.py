"""Edits of a part's placement by a gizmo: one transaction at the end of a drag, and undo."""

import threading
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi, GuiEvent, TransformControlsEvent

from hapticdb.page import checks
from hapticdb.page.browser import Browser, put
from hapticdb.page.edits import PersonsEdits
from hapticdb.page.wording import short_name
from hapticdb.poses import pose_of_row
from hapticdb.store.base import Object


@dataclass(eq=False)
class _DraggedPart:
    """A part on its gizmo.

    object : base of this browser's next move; start : pose (4, 4) of the gizmo at the placement of
    `object`; left : pose at the end of the last drag; n_waiting : moves in the queue.
    """

    object: Object
    start: NDArray[np.float64]
    left: NDArray[np.float64]
    n_waiting: int = 0

    def displacement_to(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (4, 4), world frame, of the part at a pose of the gizmo."""
        return np.asarray(pose @ np.linalg.inv(self.start))


class MoveControls:
    """Controls of the chosen part's placement, for editors.

    Drags arrive on viser's event loop, results in the thread of the edits, other people's edits in
    the follower's, and selections in viser's pool; one lock guards the gizmo.
    """

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
        self._browser = browser
        self._lock = threading.RLock()
        self._part: _DraggedPart | None = None
        self._gizmo: Any = None
        self._is_dragged = False
        is_seen = browser.visitor.may("editor") and browser.site.edits is not None
        with gui.add_folder("Move", expand_by_default=False, visible=is_seen):
            self._moves = gui.add_checkbox(
                "Move the chosen part", initial_value=False,
                hint="For everyone: the part is moved in the database when you let go of it.",
            )  # fmt: skip
            self._moves.on_update(browser.guarded("editor", self._switch))
            out = gui.add_button_group(
                "For everyone", ("Take out", "Put back"),
                hint="Takes the chosen part out of the database, or puts yours back.",
            )  # fmt: skip
            out.on_click(browser.guarded("editor", self._take_out))
            undo = browser.guarded("editor", lambda _: browser.edit(lambda own: own.undo()))
            gui.add_button("Undo", color="gray").on_click(undo)

    def follow(self) -> None:
        """Put the gizmo on the chosen part, if the box is ticked; a drag under way is dropped."""
        browser = self._browser
        with self._lock:
            self.leave()
            if self._gizmo is not None:
                self._gizmo.remove()
                self._gizmo = self._part = None
            chosen = browser.chosen
            obj = browser.site.objects.get(chosen[0]) if len(chosen) == 1 else None
            if not self._moves.value or obj is None or not browser.visitor.may("editor"):
                return
            start = np.eye(4)
            start[:3, 3] = obj.bounds.mean(axis=0)
            self._part = _DraggedPart(obj, start, start)
            self._gizmo = browser.client.scene.add_transform_controls(
                "/move", scale=0.13 * browser.site.facts.diagonal, line_width=3.5,
                position=start[:3, 3], disable_sliders=True, depth_test=False,
            )  # fmt: skip
            self._gizmo.on_update(partial(self._dragged, self._part))

    def renew(self) -> None:
        """Follow other people's moves of the part; not during a drag or a write."""
        with self._lock:
            part = self._part
            if part is None or self._is_dragged or part.n_waiting:
                return
            now = self._browser.site.objects.get(part.object.id)
            if now is None or now.revision > part.object.revision:
                self.follow()

    def leave(self) -> None:
        """Revert an unfinished drag."""
        with self._lock:
            if self._is_dragged and self._part is not None:
                self._browser.site.view.put_back(self._part.object.id)
            self._is_dragged = False

    def _switch(self, event: GuiEvent[Any]) -> None:
        if checks.flag_of(event.target.value, "moving") and len(self._browser.chosen) != 1:
            put(self._moves, value=False)
            self._browser.only_chosen()
        self.follow()

    async def _dragged(self, part: _DraggedPart, event: TransformControlsEvent) -> None:
        """Preview a drag, and write the placement at its end, if the browser is still connected."""

        def act(event: TransformControlsEvent) -> None:
            row = checks.row_of(event.target.position, event.target.wxyz)
            pose = pose_of_row(row[:3], row[3:])
            with self._lock:
                if part is not self._part:  # the gizmo was replaced: this drag is over
                    if event.phase == "end":
                        self.leave()
                    return
                self._is_dragged = True
                if event.phase != "end":  # a preview for everyone
                    placement = part.displacement_to(pose) @ part.object.transform
                    self._browser.site.view.move(part.object.id, placement)
                elif self._browser.has_gone:  # viser ends a lost browser's drags, too
                    self.leave()
                else:
                    self._is_dragged = False
                    self._end_drag(part, pose)

        self._browser.guarded("editor", act)(event)

    def _end_drag(self, part: _DraggedPart, pose: NDArray[np.float64]) -> None:
        """Write the placement at the end of a drag, based on the result of the previous write."""
        browser = self._browser
        if float(np.abs(pose @ np.linalg.inv(part.left) - np.eye(4)).max()) < 1e-9:
            self.renew()  # a click on the gizmo is no edit
            return
        part.left = pose
        part.n_waiting += 1

        def move(edits: PersonsEdits) -> Object:
            with self._lock:
                obj, displacement = part.object, part.displacement_to(pose)
            moved = edits.move(obj, displacement)
            # no later write by others
            if np.array_equal(moved.transform, displacement @ obj.transform):
                with self._lock:
                    part.object, part.start = moved, pose
            return moved

        def written(moved: Object) -> None:
            with self._lock:
                part.n_waiting -= 1
                self.renew()
            browser.notify("Done", short_name(moved.name), is_good=True)

        def refused(error: Exception) -> None:
            browser.notify("Not moved", browser.site.error_text(error))
            browser.site.view.put_back(part.object.id)
            with self._lock:
                part.n_waiting -= 1
                if part is self._part:
                    self.follow()

        assert browser.site.edits is not None  # noqa: S101 - else the box is not there
        browser.site.edits.submit(browser.client.client_id, move, written, refused)

    def _take_out(self, event: GuiEvent[Any]) -> None:
        word = checks.choice_of(event.target.value, ("Take out", "Put back"), "a step")
        if word == "Put back":
            self._browser.edit(lambda own: own.put_back())
        else:
            obj = self._browser.only_chosen()
            self._browser.edit(lambda own: own.take_out(obj))
