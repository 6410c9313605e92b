"""Moving a part by its gizmo, in the tab Parts: one transaction when it is let go of, and undo."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.page import checks
from hapticdb.page.widgets import put
from hapticdb.store.base import Object

if TYPE_CHECKING:
    from viser import GuiApi, GuiEvent, TransformControlsEvent

    from hapticdb.page.browser import Browser

MOVING_GIZMO = 0.13
"""Size of a part's gizmo, as a share of the scene's diagonal; larger than the hand's, to tell both
apart."""
LEAST_WAY = 1e-9
"""Least change of a part's placement, metres or radians, that is written. Larger: small moves are
lost; at 0 a click on the gizmo would be an edit."""


class MovingControls:
    """Moves the chosen part, for editors.

    Parameters
    ----------
    browser : Browser
        Whose hand moves.
    gui : GuiApi
        Where the controls are made: inside the present container.
    """

    def __init__(self, browser: "Browser", gui: "GuiApi") -> None:
        self._browser = browser
        self._object: Object | None = None
        self._gizmo: Any = None
        self._start = np.eye(4)
        self._is_dragged = False
        is_seen = browser.visitor.may("editor") and browser.site.edits is not None
        with gui.add_folder("Move", expand_by_default=False, visible=is_seen):
            self._moves = gui.add_checkbox(
                "Move the chosen part", initial_value=False,
                hint="For everyone: the part is moved in the database when you let go of it.",
            )  # fmt: skip
            self._moves.on_update(browser.guarded("editor", self._switch))
            self._out = gui.add_button_group(
                "For everyone", ("Take out", "Put back"),
                hint="Takes the chosen part out of the database, or puts yours back.",
            )  # fmt: skip
            self._out.on_click(browser.guarded("editor", self._take_out))
            self._undo = gui.add_button("Undo", color="gray")
            self._undo.on_click(browser.guarded("editor", self._undo_last))

    def follow(self) -> None:
        """Put the gizmo on the chosen part, where the box is ticked."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = self._object = None
        browser = self._browser
        if not self._moves.value or len(browser.chosen) != 1:
            return
        obj = browser.site.objects[browser.chosen[0]]
        middle = obj.bounds.mean(axis=0)
        self._object, self._start = obj, np.eye(4)
        self._start[:3, 3] = middle
        size = browser.site.stage.diagonal
        scene = browser.client.scene
        self._gizmo = scene.add_transform_controls(
            "/move", scale=MOVING_GIZMO * size, line_width=3.5, position=middle,
            disable_sliders=True, depth_test=False,
        )  # fmt: skip
        self._gizmo.on_update(self._dragged)

    def renew(self) -> None:
        """Put the gizmo where the part is now, if somebody has moved it."""
        obj = self._object
        if obj is None or self._is_dragged:
            return
        now = self._browser.site.objects.get(obj.id)
        if now is None or now.revision != obj.revision:
            self.follow()

    def leave(self) -> None:
        """Take back a move that was not finished when the browser went."""
        if self._is_dragged and self._object is not None:
            self._browser.site.view.put_back(self._object.id)

    def _switch(self, event: "GuiEvent[Any]") -> None:
        if checks.flag_of(event.target.value, "moving") and len(self._browser.chosen) != 1:
            put(self._moves, value=False)
            raise UsageError("choose one part first: click it, or take it from the list")
        self.follow()

    async def _dragged(self, event: "TransformControlsEvent") -> None:
        """Write the part's new placement when it is let go of."""

        def act(event: "TransformControlsEvent") -> None:
            pose = checks.pose_of(event.target.position, event.target.wxyz)
            self._is_dragged = event.phase != "end"
            if event.phase == "end":
                self._write(pose)
            elif self._object is not None:  # everyone sees where it goes
                way = pose @ np.linalg.inv(self._start)
                self._browser.site.view.move(self._object.id, way @ self._object.transform)

        self._browser.guarded("editor", act)(event)

    def _write(self, pose: NDArray[np.float64]) -> None:
        obj, browser = self._object, self._browser
        way = pose @ np.linalg.inv(self._start)
        if obj is None or float(np.abs(way - np.eye(4)).max()) < LEAST_WAY:
            return

        def refused(error: Exception) -> None:
            browser.tell("Not moved", browser.site.error_text(error))
            browser.site.view.put_back(obj.id)
            self.follow()

        assert browser.site.edits is not None  # noqa: S101 - else the box is not there
        browser.site.edits.ask(
            browser.number, lambda edits: edits.move(obj, way), self._written, refused
        )

    def _take_out(self, event: "GuiEvent[Any]") -> None:
        word = checks.choice_of(event.target.value, ("Take out", "Put back"), "a step")
        browser = self._browser
        edits = browser.site.edits
        if edits is None:
            return
        if word == "Put back":
            edits.ask(browser.number, lambda own: own.put_back(), self._written, browser.failed)
            return
        if len(browser.chosen) != 1:
            raise UsageError("choose one part first: click it, or take it from the list")
        obj = browser.site.objects[browser.chosen[0]]
        edits.ask(browser.number, lambda own: own.take_out(obj), self._written, browser.failed)

    def _undo_last(self, _: object) -> None:
        browser = self._browser
        if browser.site.edits is not None:
            browser.site.edits.ask(
                browser.number, lambda edits: edits.undo(), self._written, browser.failed
            )

    def _written(self, said: str) -> None:
        self._browser.tell("Done", said, is_good=True)
