"""Tab Sweep: verdict, hits and least distance of a tool or a part along a path."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi

from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.exact.sweep import sweep
from hapticdb.exact.sweep_report import gap_text, name_of, percent, verdict_line
from hapticdb.exact.swept import PathPlace, Swept
from hapticdb.page import checks, colours, tools
from hapticdb.page.browser import Browser
from hapticdb.page.drawing import add_marks, add_tool, put_at
from hapticdb.page.panels.jobs import PanelJob, Progress
from hapticdb.page.wording import escaped, note_html, plain_name, short_name, swatch
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import pose_of_row, row_of_pose

Floats = NDArray[np.float64]

MOST_NAMED = 8
"""Greatest number of listed hits."""
SECONDS = 60.0
"""Time limit of a sweep, as of a search by the command line: others wait for its thread."""
COLOURS = {0: "#1f8a4c", 1: "#c62838", 3: "#a8730f", 4: "#a8730f"}
"""Colours of verdicts, by exit status."""
DIRECTIONS = {
    "to the hand": None, "+x": (0, 1.0), "-x": (0, -1.0), "+y": (1, 1.0), "-y": (1, -1.0),
    "+z": (2, 1.0), "-z": (2, -1.0),
}  # fmt: skip
"""Directions of a sweep: axis of the world frame and sign; None: towards the hand."""


class SweepPanel:
    """Sweeps of this browser's tool or chosen part, and display of their results."""

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
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
        gui.add_button("Run the sweep").on_click(guard("viewer", self._begin))
        self._work = PanelJob(browser, gui, "a sweep", "parts near the way")
        self._clear = gui.add_button("Clear", color="gray", visible=False)
        self._clear.on_click(guard("viewer", self._clean))

    def _begin(self, _: object) -> None:
        browser = self._browser
        is_part = checks.choice_of(self._what.value, self._what.options, "what").endswith("part")
        word = checks.choice_of(self._direction.value, DIRECTIONS, "a direction")
        length = checks.number_of(self._length.value, 0.0, self._farthest, "a length")
        part = browser.dragged_part if is_part else None
        if is_part and part is None:
            part = browser.only_chosen().id
        site, tool = browser.site, browser.tool
        hand = pose_of_row(browser.hand[:3], browser.hand[3:])
        first = browser.matrix_of_tool() if part is None else np.eye(4)
        is_seated, ids = part is not None, [] if part is None else [part]
        exclude = {*browser.excluded_ids, *ids}
        name = tool.name if part is None else short_name(site.objects[part].name)

        def run(progress: Progress) -> tuple[PointShell, Swept]:
            with open_environment(site.url, read_only=True) as env:
                shell = env.shell(*ids, inset=0.0) if is_seated else tool.shell
                middle = tools.middle_of(shell) if is_seated else np.zeros(3)
                poses = _path(first, DIRECTIONS[word], length, hand, middle)
                present = [i for i in exclude if i in site.objects]
                return shell, sweep(
                    env, shell, poses, exclude=present, seated=is_seated, seconds=SECONDS,
                    progress=progress,
                )  # fmt: skip

        self._work.begin(run, lambda found: self._show(*found, name))

    def _show(self, shell: PointShell, swept: Swept, name: str) -> None:
        self._erase()
        place = swept.hits[0] if swept.hits else swept.gap.place
        if place is not None:
            self._draw(shell, swept, place, name)
        self._work.said.content = swept_html(swept, verdict_line(swept, shell), name)
        self._clear.visible = True

    def _draw(self, shell: PointShell, swept: Swept, place: PathPlace, name: str) -> None:
        """Draw the tool at the first hit or the least distance, and the nearest points there."""
        scene = self._browser.client.scene
        ghost = tools.from_shell(name, shell)
        pose = place.pose.copy()
        pose[:3, 3] += pose[:3, :3] @ tools.middle_of(shell)
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


def swept_html(swept: Swept, line: str, name: str) -> str:
    """HTML of a result: the verdict about a name, its line, and the hits."""
    hit = "".join(
        f"<div>{swatch(colours.of_object(place.object.id))}"
        f"{escaped(short_name(name_of(place)))} · at {percent(place.fraction)}</div>"
        for place in swept.hits[:MOST_NAMED]
    )
    more = len(swept.hits) - MOST_NAMED
    line = line.replace("give more --seconds", "hapticdb sweep has no time limit")
    return (
        '<div style="margin:2px 12px;font-size:0.85em">'
        f'<b style="color:{COLOURS[swept.verdict.exit_status]}">'
        f"{escaped(name)}: {escaped(swept.verdict)}</b>"
        f'<div style="margin:3px 0">{escaped(plain_name(line))}</div>{hit}'
        f"{f'<div>and {more} more</div>' if more > 0 else ''}</div>"
    )


def _path(
    first: Floats, direction: tuple[int, float] | None, length: float, hand: Floats, middle: Floats
) -> Floats:
    """Poses (2, 4, 4) along a direction, or until the place `middle` (3,) is at the hand (4, 4)."""
    last = hand.copy() if direction is None else first.copy()
    if direction is None:
        last[:3, 3] -= hand[:3, :3] @ middle
    else:
        last[direction[0], 3] += direction[1] * length
    if np.abs(last - first).max() <= 1e-12:
        raise UsageError("a path of no length: give a length, or move the hand")
    return np.stack([first, last])
