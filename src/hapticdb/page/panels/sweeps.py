"""The tab Sweep: whether a tool, or a part, comes out along a way, and where it hits."""

import logging
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.page import checks, colours, tools
from hapticdb.page.browser import Browser
from hapticdb.page.database import opened
from hapticdb.page.drawing import add_tool, put_at
from hapticdb.page.widgets import put
from hapticdb.page.wording import escaped, note_html, plain_name, short_name, swatch
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import quaternion_of
from hapticdb.sweeps import run as sweeps
from hapticdb.sweeps.result import Moment, Swept
from hapticdb.sweeps.verdict import percent, verdict_line

if TYPE_CHECKING:
    from viser import GuiApi

LOG = logging.getLogger("hapticdb.page")
Floats = NDArray[np.float64]

MOST_POINTS = 20_000
"""Points of a swept part. Larger: "comes out" is proved for larger parts, in more time."""
MOST_NAMED = 8
"""Objects that the answer names, with where each is hit."""
WAYS = {
    "to the hand": None, "+x": (0, 1.0), "-x": (0, -1.0), "+y": (1, 1.0), "-y": (1, -1.0),
    "+z": (2, 1.0), "-z": (2, -1.0),
}  # fmt: skip
"""Ways of a sweep: the axis of the scene and its sign; None: from where it is to the hand."""


class _SweepAnswer(NamedTuple):
    """A sweep's answer, to be drawn.

    shell : what was swept; swept : the result; moment : where it is caught, or else where it hits
    first, or None; marks (H, 3) : its points in voxels there, metres.
    """

    shell: PointShell
    swept: Swept
    moment: Moment | None
    marks: Floats


class SweepPanel:
    """Runs sweeps of this browser's tool or chosen part, and shows what they hit.

    gui : where the panel is made, inside the present container.
    """

    def __init__(self, browser: Browser, gui: "GuiApi") -> None:
        self._browser = browser
        self._drawn: list[Any] = []
        self._is_running = False
        guard = browser.guarded
        gui.add_html(
            note_html("Moves a part or the tool along a way, and says what is in its way.")
        )
        self._what = gui.add_dropdown("What", ("the chosen part", "the tool"))
        self._way = gui.add_dropdown(
            "Way", tuple(WAYS), initial_value=f"+{'xyz'[int(browser.site.facts.up.argmax())]}"
        )
        diagonal = browser.site.facts.diagonal
        self._farthest = 10.0 * diagonal
        self._length = gui.add_number(
            "Length, m", round(0.25 * diagonal, 3), min=0.0, max=self._farthest, step=0.001
        )
        self._run = gui.add_button("Run the sweep")
        self._run.on_click(guard("viewer", self._begin))
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._said = gui.add_html("")
        self._clear = gui.add_button("Clear", color="gray", visible=False)
        self._clear.on_click(guard("viewer", lambda _: self._erase()))

    def _begin(self, _: object) -> None:
        if self._is_running:
            raise UsageError("a sweep is running: wait for it")
        browser = self._browser
        is_part = checks.choice_of(self._what.value, self._what.options, "what").endswith("part")
        way = checks.choice_of(self._way.value, WAYS, "a way")
        length = checks.number_of(self._length.value, 0.0, self._farthest, "a length")
        part = None
        if is_part:
            part = browser.taken if browser.taken is not None else browser.only_chosen().id
        job = _SweepJob(browser, part, way, length)
        self._is_running = True
        self._erase()
        put(self._bar, 0.0)
        self._bar.visible = True
        self._said.content = note_html("Waits for its turn, then moves it along.")
        browser.site.sweeping.submit(self._work, job)

    def _work(self, job: "_SweepJob") -> None:
        """Sweep; in the site's thread for sweeps."""
        try:
            self._show(job.run(self._progress), job.name)
        except HapticDBError as error:
            self._said.content = note_html(self._browser.site.error_text(error))
        except Exception:
            LOG.exception("a sweep of the page failed")
            self._said.content = note_html("The sweep failed; the operator's log says why.")
        finally:
            self._is_running = False
            self._bar.visible = False

    def _progress(self, done: int, total: int) -> None:
        put(self._bar, 100.0 * done / max(total, 1))

    def _show(self, found: _SweepAnswer, name: str) -> None:
        swept, scene = found.swept, self._browser.client.scene
        line = verdict_line(swept, found.shell)
        colour = {"hits": "#c62838", "comes out": "#1f8a4c"}.get(swept.verdict, "#a8730f")
        hit = "".join(
            f"<div>{swatch(colours.of_object(met.object.id))}"
            f"{escaped(short_name(met.object.name))} · at {percent(met.first)}</div>"
            for met in swept.objects[:MOST_NAMED]
        )
        more = len(swept.objects) - MOST_NAMED
        self._said.content = (
            f'<div style="margin:2px 12px;font-size:0.85em"><b style="color:{colour}">'
            f"{escaped(name)}: {escaped(swept.verdict)}</b>"
            f'<div style="margin:3px 0">{escaped(plain_name(line))}</div>{hit}'
            f"{f'<div>and {more} more</div>' if more > 0 else ''}</div>"
        )
        self._clear.visible = True
        moment = found.moment
        if moment is None:
            return
        ghost = tools.from_shell(name, found.shell)
        middle = tools.middle_of(found.shell)
        pose = moment.pose.copy()
        pose[:3, 3] += pose[:3, :3] @ middle
        node = add_tool(scene, "/swept", ghost, colours.MARK, 0.4)
        put_at(node, np.concatenate([pose[:3, 3], quaternion_of(pose[:3, :3])[0]]))
        self._drawn = [node]
        if len(found.marks):
            word = "first hit" if swept.caught is None else "caught"
            size = self._browser.site.facts.diagonal
            self._drawn.append(
                scene.add_point_cloud(
                    "/swept_hits", found.marks, (255, 214, 0), point_size=0.007 * size,
                    point_shape="circle", precision="float32",
                )
            )  # fmt: skip
            self._drawn.append(
                scene.add_label(
                    "/swept_label", f"{word} at {percent(moment.fraction)}",
                    position=found.marks.mean(axis=0), anchor="bottom-left",
                )
            )  # fmt: skip

    def _erase(self) -> None:
        for node in self._drawn:
            node.remove()
        self._drawn = []
        self._said.content = ""
        self._clear.visible = False


class _SweepJob:
    """A sweep as it was asked for: later clicks do not change it.

    part : id of the swept object; None: the tool; way : one of `WAYS`; length : of a way along an
    axis, metres.
    """

    def __init__(self, browser: Browser, part: int | None, way: str, length: float) -> None:
        self._site = browser.site
        self._part = part
        self._way, self._length = WAYS[way], length
        self._tool = browser.tool
        self._hand = browser.matrix_of_hand()
        self._from = browser.matrix_of_tool()
        self._exclude = {*browser.unfelt, *(() if part is None else (part,))}
        obj = None if part is None else browser.site.objects[part]
        self.name = self._tool.name if obj is None else short_name(obj.name)

    def run(self, progress: sweeps.SampleCallback) -> _SweepAnswer:
        """Sweep on a connection of its own."""
        with opened(self._site.url, self._site.folders) as env:
            if self._part is None:
                shell = self._tool.shell
            else:
                spacing = 0.5 * env.grid.voxel_size
                shell = env.shell(self._part, points=MOST_POINTS, spacing=spacing)
            present = [i for i in self._exclude if i in self._site.objects]
            swept = sweeps.sweep(env, shell, self._path(shell), exclude=present, progress=progress)
            marks = np.empty((0, 3))
            moment = swept.caught or swept.first_hit
            if moment is not None:
                pose = moment.pose
                touch = env.touch(shell, pose, exclude=present, law="plane")
                marks = shell.points[touch.hits] @ pose[:3, :3].T + pose[:3, 3]
        return _SweepAnswer(shell, swept, moment, marks)

    def _path(self, shell: PointShell) -> Floats:
        """Poses of the sweep: of the tool, or displacements of the part from its place."""
        first = self._from if self._part is None else np.eye(4)
        last = first.copy()
        if self._way is not None:
            axis, sign = self._way
            last[axis, 3] += sign * self._length
        elif self._part is None:
            last = self._hand
        else:
            middle = np.eye(4)
            middle[:3, 3] = tools.middle_of(shell)
            last = self._hand @ np.linalg.inv(middle)
        if math.isclose(float(np.abs(last - first).max()), 0.0, abs_tol=1e-12):
            raise UsageError("a way of no length: give a length, or move the hand")
        return np.stack([first, last])
