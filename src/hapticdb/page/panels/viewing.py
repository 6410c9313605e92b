"""Folder View: standard views, what to fit, a section, and a link to what is seen."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi, GuiEvent

from hapticdb.errors import UsageError
from hapticdb.grid import corners_of
from hapticdb.page import checks
from hapticdb.page.browser import LEAST_SHOWN, Browser
from hapticdb.page.scene.surroundings import FIELD_OF_VIEW

Floats = NDArray[np.float64]
FITS = ("Chosen", "Tool", "All")
TILT = 1e-3
"""Tilt of the views from top and bottom, radians: the screen's upward direction needs one."""


def sides_of(up: int) -> dict[str, Floats]:
    """Directions (3,) from the middle to the eye; right is x, front is -y, or z for files of y."""
    over, right = np.eye(3)[up], np.eye(3)[1 if up == 0 else 0]
    front = np.cross(right, over)
    return {
        "Front": front, "Back": -front, "Left": -right, "Right": right,
        "Top": over + TILT * front, "Bottom": TILT * front - over,
        "Isometric": front + right + over,
    }  # fmt: skip


class ViewControls:
    """Camera of one browser. The section is viser's near plane, at a share of the scene's depth."""

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
        self._browser, self._camera = browser, browser.client.camera
        self._sides = sides_of(browser.site.view.up)
        self._corners = corners_of(browser.site.facts.bounds)
        self._least = browser.site.server.initial_camera.near
        self._linked: object = None
        self._linked_at = -math.inf
        guard = browser.guarded
        with gui.add_folder("View", expand_by_default=False):
            sides = gui.add_button_group("From", tuple(self._sides))
            sides.on_click(guard("viewer", self._look_from))
            gui.add_button_group("Fit", FITS).on_click(guard("viewer", self._fit))
            self._section = gui.add_slider(
                "Section, %", 0.0, 100.0, 0.5, round(100.0 * self._share_of_near(), 1),
                hint="Cuts away what is nearer, parallel to the screen: turn the scene to tilt it.",
            )  # fmt: skip
            self._section.on_update(guard("viewer", self._cut))
            self._link = gui.add_html("")
        self._camera.on_update(guard("viewer", self._cut))

    def _look_from(self, event: GuiEvent[Any]) -> None:
        side = self._sides[checks.choice_of(event.target.value, self._sides, "a side")]
        target = self._camera.look_at
        away = float(np.linalg.norm(self._camera.position - target))
        self._browser.scene.fly_to(target, away * math.sin(FIELD_OF_VIEW / 2), side)

    def _fit(self, event: GuiEvent[Any]) -> None:
        browser, word = self._browser, checks.choice_of(event.target.value, FITS, "what to fit")
        if word == "Tool":
            radius = max(2.0 * browser.tool.radius, LEAST_SHOWN * browser.site.facts.diagonal)
            browser.scene.fly_to(browser.hand[:3], radius)
            return
        ids = set(browser.chosen) if word == "Chosen" else {*browser.site.objects}
        ids -= browser.scene.hidden
        if not ids:
            raise UsageError("choose a part first: click it, or press its name")
        browser.scene.fit(ids)

    def _depths(self) -> tuple[Floats, float, float]:
        """Unit vector (3,) of the view, and least and greatest depth of the scene, metres."""
        ahead = self._camera.look_at - self._camera.position
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
        depths = (self._corners - self._camera.position) @ ahead
        return ahead, float(depths.min()), float(depths.max())

    def _share_of_near(self) -> float:
        """Share of the scene's depth at the near plane: above 0 when a link has one."""
        _, low, high = self._depths()
        near = self._camera.near
        is_cut = near > 1.001 * self._least
        return min(max((near - low) / (high - low), 0.0), 1.0) if is_cut else 0.0

    def _cut(self, _: object) -> None:
        """Put the near plane where the section is, for the camera of now."""
        share = checks.number_of(self._section.value, 0.0, 100.0, "a section") / 100.0
        _, low, high = self._depths()
        self._camera.near = max(self._least, low + share * (high - low)) if share else self._least

    def seen_from(self, origin: Floats, way: Floats) -> Floats:
        """Where a ray (3,), (3,) from the eye passes the near plane."""
        # the near plane is at `near` along the view, so farther along an oblique ray
        along = float(way @ self._depths()[0])
        return origin + way * (self._camera.near / along) if along > 0.0 else origin

    def tick(self, now: float) -> None:
        """Update the link, three times a second; called by the page's clock."""
        camera, chosen = self._camera, self._browser.chosen[:50]  # as many as the server accepts
        seen = (tuple(camera.position), tuple(camera.look_at), camera.near, chosen)
        if now - self._linked_at < 0.3 or seen == self._linked:
            return
        self._linked_at, self._linked = now, seen
        is_below = bool(self._browser.visitor.shown)  # the page's own address ends in "see/..."
        path = "../" if is_below else ""
        if chosen:
            path = ("" if is_below else "see/") + ",".join(map(str, chosen))
        position, target = (",".join(f"{x:.10g}" for x in place) for place in seen[:2])
        query = f"initialCameraPosition={position}&amp;initialCameraLookAt={target}"
        if camera.near > self._least:
            query += f"&amp;initialCameraNear={camera.near:.6g}"
        self._link.content = (
            '<div style="font-size:0.85em;margin:2px 12px"><a target="_blank" '
            f'href="{path}?{query}">Link to this view</a>, with {len(chosen):,} chosen</div>'
        )
