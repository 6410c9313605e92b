"""Tab Sweep, a machine: its base on a gizmo, its joint path, and the sweep along it."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi

from hapticdb.environment import open as open_environment
from hapticdb.errors import HapticDBError
from hapticdb.exact.sweep_report import gap_text, name_of, percent, verdict_line
from hapticdb.exact.swept import Swept
from hapticdb.machines.joint_path import checked_values
from hapticdb.machines.machine import Machine
from hapticdb.machines.machine_sweep import sweep_machine
from hapticdb.page import checks, colours
from hapticdb.page.browser import Browser, put
from hapticdb.page.drawing import add_marks, put_at
from hapticdb.page.panels.jobs import PanelJob, Progress
from hapticdb.page.panels.sweeps import SECONDS, swept_html
from hapticdb.page.site import TICKS
from hapticdb.page.wording import note_html
from hapticdb.poses import pose_of_row, row_of_pose

Floats = NDArray[np.float64]

PLAYED = 6.0
"""Duration of the played path, seconds."""


class MachinePanel:
    """A machine in one browser; q (M, J) : joint path, as of `sweep_machine`.

    The text is the pose of the base; a drag of the gizmo writes it, so a sweep of the command line
    gets the same numbers.
    """

    def __init__(self, browser: Browser, gui: GuiApi, machine: Machine, q: Floats) -> None:
        self._browser, self._machine, self._q = browser, machine, q
        self._values = checked_values(machine, q)
        self._marks: list[Any] = []
        guard, site, scene = browser.guarded, browser.site, browser.client.scene
        assert site.request.machine is not None  # noqa: S101 - else there is no panel
        start = row_of_pose(site.request.machine.at)
        gui.add_html(note_html("Drag the base. The sweep proves the path between its rows, too."))
        self._at = gui.add_text(
            "Base, mm", _text_of(start), hint="x,y,z,qw,qx,qy,qz, as of sweep --at."
        )
        self._at.on_update(guard("viewer", self._typed))
        last = len(self._values) - 1
        self._row = gui.add_slider("Row of the path", 0.0, float(last), last / 1000.0, 0.0)
        self._row.on_update(guard("viewer", self._pose_links))
        self._plays = gui.add_checkbox("Play the path", initial_value=False)
        gui.add_button("Sweep the machine").on_click(guard("viewer", self._begin))
        self._work = PanelJob(browser, gui, "a sweep", "parts near the way")
        self._base = scene.add_transform_controls(
            "/machine", scale=0.13 * site.facts.diagonal, line_width=3.5,
            disable_sliders=True, depth_test=False,
        )  # fmt: skip
        self._links: dict[int, Any] = {}
        for link, surface in machine.surfaces.items():
            corners = surface.tree.corners.reshape(-1, 3)
            self._links[link] = scene.add_mesh_simple(
                f"/machine/{link}", corners, np.arange(len(corners)).reshape(-1, 3),
                color=browser.colour, flat_shading=True, side="double", receive_shadow=False,
            )  # fmt: skip
        put_at(self._base, start)
        self._base.on_update(self._moved)
        self._pose_links(None)
        browser.works.append(self)

    def tick(self) -> None:
        """Play the path; called by the page's clock."""
        if self._plays.value is True:
            last = len(self._values) - 1
            put(self._row, (self._row.value + last / (PLAYED * TICKS)) % last)

    def _pose_links(self, _: object) -> None:
        """Draw the links at the slider's row."""
        rows = len(self._values)
        at = checks.number_of(self._row.value, 0.0, rows - 1.0, "a row")
        values = np.array([[np.interp(at, np.arange(rows), one) for one in self._values.T]])
        placed = self._machine.all_placed(values)
        with self._browser.client.atomic():
            for link, node in self._links.items():
                put_at(node, row_of_pose(placed[link][0]))

    def _row_of_base(self) -> Floats:
        """Pose (7,) of the base, metres."""
        words = checks.text_of(self._at.value, 300, "the base").replace(",", " ").split()
        row = checks.row_of(words[:3], words[3:])
        row[:3] *= 1e-3
        return row

    def _typed(self, event: Any) -> None:  # noqa: ANN401 - an event of viser
        if event.client is not None:  # None: written by a drag
            put_at(self._base, self._row_of_base())

    async def _moved(self, event: Any) -> None:  # noqa: ANN401 - an event of viser
        def act(event: Any) -> None:  # noqa: ANN401 - likewise
            put(self._at, _text_of(checks.row_of(event.target.position, event.target.wxyz)))

        self._browser.guarded("viewer", act)(event)

    def _begin(self, _: object) -> None:
        row = self._row_of_base()
        self._work.begin(partial(self._swept, pose_of_row(row[:3], row[3:])), self._show)

    def _swept(self, at: Floats, progress: Progress) -> Swept:
        """Sweep on a separate connection."""
        site = self._browser.site
        with open_environment(site.url, read_only=True) as env:
            return sweep_machine(
                env, self._machine, self._q, at=at, exclude=self._browser.excluded_ids,
                seconds=SECONDS, progress=progress,
            )  # fmt: skip

    def _show(self, found: Swept) -> None:
        """Draw the machine at the first hit or the least distance, and say the verdict."""
        site = self._browser.site
        for node in self._marks:
            node.remove()
        self._marks = []
        place = found.hits[0] if found.hits else found.gap.place
        for link, node in self._links.items():
            is_hit = found.hits and place and self._machine.names[link] == place.body
            node.color = colours.MARK if is_hit else self._browser.colour
        if place is not None:
            path = found.path
            put(self._plays, value=False)
            rows = np.arange(len(path.poses))
            put(self._row, float(np.interp(place.fraction * path.length, path.parameters, rows)))
            words = "hit" if found.hits else f"{gap_text(found)} from"
            self._marks = add_marks(
                self._browser.client.scene, "/machine_places",
                np.stack([place.on_object, place.on_tool]),
                f"{words} {name_of(place)} at {percent(place.fraction)}",
                0.007 * site.facts.diagonal,
            )  # fmt: skip
        notes = [note_html(site.error_text(HapticDBError(note))) for note in found.notes]
        self._work.said.content = "".join(
            [swept_html(found, verdict_line(found, None), "machine"), *notes]
        )


def _text_of(row: Floats) -> str:
    """Pose (7,), metres, as of sweep --at: millimetres, quaternion."""
    return ",".join(f"{x:.9g}" for x in (*(1e3 * row[:3]), *row[3:]))
