"""Tab Sweep: verdict, hits and least distance of a tool or a part along a path."""

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.exact.sweep import sweep
from hapticdb.exact.sweep_report import gap_text, percent, verdict_line
from hapticdb.exact.swept import PathPlace, Swept
from hapticdb.page import checks, colours, tools
from hapticdb.page.browser import Browser
from hapticdb.page.drawing import add_marks, add_tool, put_at
from hapticdb.page.panels.jobs import PanelJob, Progress
from hapticdb.page.wording import escaped, note_html, plain_name, short_name, swatch
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import row_of_pose

if TYPE_CHECKING:
    from viser import GuiApi

Floats = NDArray[np.float64]

MOST_NAMED = 8
"""Greatest number of listed hits."""
COLOURS = {0: "#1f8a4c", 1: "#c62838", 3: "#a8730f", 4: "#a8730f"}
"""Colours of verdicts, by exit status."""
DIRECTIONS = {
    "to the hand": None, "+x": (0, 1.0), "-x": (0, -1.0), "+y": (1, 1.0), "-y": (1, -1.0),
    "+z": (2, 1.0), "-z": (2, -1.0),
}  # fmt: skip
"""Directions of a sweep: axis of the world frame and sign; None: towards the hand."""


class _SweepAnswer(NamedTuple):
    """Result of a sweep, and the swept shell."""

    shell: PointShell
    swept: Swept

    @property
    def place(self) -> PathPlace | None:
        """Place of the first hit, or of the least distance without a hit."""
        return self.swept.hits[0] if self.swept.hits else self.swept.gap.place


class SweepPanel:
    """Sweeps of this browser's tool or chosen part, and display of their results."""

    def __init__(self, browser: Browser, gui: "GuiApi") -> None:
        self._browser = browser
        self._drawn: list[Any] = []
        guard = browser.guarded
        gui.add_html(note_html("Moves a part or the tool along a path, and says what it hits."))
        self._what = gui.add_dropdown("What", ("the chosen part", "the tool"))
        self._direction = gui.add_dropdown(
            "Direction",
            tuple(DIRECTIONS),
            initial_value=f"+{'xyz'[int(browser.site.facts.up.argmax())]}",
        )
        diagonal = browser.site.facts.diagonal
        self._farthest = 10.0 * diagonal
        self._length = gui.add_number(
            "Length, m", round(0.25 * diagonal, 3), min=0.0, max=self._farthest, step=0.001
        )
        self._run = gui.add_button("Run the sweep")
        self._run.on_click(guard("viewer", self._begin))
        self._work = PanelJob(browser, gui, "a sweep", "parts near the way")
        self._clear = gui.add_button("Clear", color="gray", visible=False)
        self._clear.on_click(guard("viewer", self._clean))

    def _begin(self, _: object) -> None:
        browser = self._browser
        is_part = checks.choice_of(self._what.value, self._what.options, "what").endswith("part")
        direction = checks.choice_of(self._direction.value, DIRECTIONS, "a direction")
        length = checks.number_of(self._length.value, 0.0, self._farthest, "a length")
        part = None
        if is_part:
            part = (
                browser.dragged_part
                if browser.dragged_part is not None
                else browser.only_chosen().id
            )
        job = _SweepJob(browser, part, direction, length)
        self._work.begin(job.run, lambda found: self._show(found, job.name))

    def _show(self, found: _SweepAnswer, name: str) -> None:
        swept = found.swept
        self._erase()
        if found.place is not None:
            self._draw(found, found.place, name)
        line = verdict_line(swept, found.shell)
        hit = "".join(
            f"<div>{swatch(colours.of_object(place.object.id))}"
            f"{escaped(short_name(place.object.name))} · at {percent(place.fraction)}</div>"
            for place in swept.hits[:MOST_NAMED]
        )
        more = len(swept.hits) - MOST_NAMED
        self._work.said.content = (
            '<div style="margin:2px 12px;font-size:0.85em">'
            f'<b style="color:{COLOURS[swept.verdict.exit_status]}">'
            f"{escaped(name)}: {escaped(swept.verdict)}</b>"
            f'<div style="margin:3px 0">{escaped(plain_name(line))}</div>{hit}'
            f"{f'<div>and {more} more</div>' if more > 0 else ''}</div>"
        )
        self._clear.visible = True

    def _draw(self, found: _SweepAnswer, place: PathPlace, name: str) -> None:
        """Draw the tool at the first hit or the least distance, and the nearest points there."""
        scene, swept = self._browser.client.scene, found.swept
        ghost = tools.from_shell(name, found.shell)
        pose = place.pose.copy()
        pose[:3, 3] += pose[:3, :3] @ tools.middle_of(found.shell)
        colour = colours.MARK if swept.hits else self._browser.colour
        node = add_tool(scene, "/swept", ghost, colour, 0.4)
        put_at(node, row_of_pose(pose))
        words = "hit" if swept.hits else f"nearest, {gap_text(swept)},"
        self._drawn = [
            node,
            *add_marks(
                scene, "/swept_places", np.stack([place.on_object, place.on_tool]),
                f"{words} at {percent(place.fraction)}", 0.007 * self._browser.site.facts.diagonal,
            ),
        ]  # fmt: skip

    def _clean(self, _: object) -> None:
        self._erase()
        self._work.said.content = ""

    def _erase(self) -> None:
        for node in self._drawn:
            node.remove()
        self._drawn = []
        self._clear.visible = False


class _SweepJob:
    """Request of a sweep; part : id, None for the tool; direction : a key; length : metres."""

    def __init__(self, browser: Browser, part: int | None, direction: str, length: float) -> None:
        self._site = browser.site
        self._part = part
        self._direction, self._length = DIRECTIONS[direction], length
        self._tool = browser.tool
        self._hand = browser.matrix_of_hand()
        self._from = browser.matrix_of_tool()
        self._exclude = {*browser.excluded_ids, *(() if part is None else (part,))}
        obj = None if part is None else browser.site.objects[part]
        self.name = self._tool.name if obj is None else short_name(obj.name)

    def run(self, progress: Progress) -> _SweepAnswer:
        """Sweep on a separate connection."""
        with open_environment(self._site.url, read_only=True) as env:
            shell = self._tool.shell if self._part is None else env.shell(self._part, inset=0.0)
            present = [i for i in self._exclude if i in self._site.objects]
            swept = sweep(
                env, shell, self._path(shell), exclude=present, seated=self._part is not None,
                progress=progress,
            )  # fmt: skip
        return _SweepAnswer(shell, swept)

    def _path(self, shell: PointShell) -> Floats:
        """Poses (2, 4, 4) of the tool, or displacements of the part from its placement."""
        first = self._from if self._part is None else np.eye(4)
        last = first.copy()
        if self._direction is not None:
            axis, sign = self._direction
            last[axis, 3] += sign * self._length
        elif self._part is None:
            last = self._hand
        else:
            middle = np.eye(4)
            middle[:3, 3] = tools.middle_of(shell)
            last = self._hand @ np.linalg.inv(middle)
        if math.isclose(float(np.abs(last - first).max()), 0.0, abs_tol=1e-12):
            raise UsageError("a path of no length: give a length, or move the hand")
        return np.stack([first, last])
