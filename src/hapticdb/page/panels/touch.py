"""Tab Touch: wrench, touched objects and force plot; tool, stiffness and scale."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi, GuiEvent, GuiUplotHandle
from viser.uplot import Axis, Legend, Scale, Series

from hapticdb.page import checks, colours
from hapticdb.page.browser import Browser, put
from hapticdb.page.wording import MOST_SAID, escaped, note_html, short_name, swatch
from hapticdb.recording.frame import State
from hapticdb.session.coupling import limit_text
from hapticdb.store.base import Object

SHOWN_EVERY = 0.2
"""Period of numbers and plot, seconds."""
SECONDS = 10.0
"""Time span of the plot, seconds."""
HIGHEST = 8.0
"""Top of the plot, N: above the force cap of 7 N. That of torques is at the tool's lever."""
SOFTEST, STIFFEST = 50.0, 3000.0
"""Range of the coupling's stiffness, N/m. Larger: harder surfaces, at the force cap sooner."""
PART = "(a part)"
"""Entry of the list for a dragged part."""
SCALES = (0.05, 20.0)
"""Range of the scale, as multiples of the initial one."""


class TouchPanel:
    """Readings of the session's newest frame, and controls of tool, stiffness and scale."""

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
        self._browser = browser
        self._shown_at = 0.0
        may_touch = browser.visitor.may("toucher")
        self._reading = gui.add_html(
            self._reading_html(0.0, 0.0, [], "The tool is being made ready.", is_held=may_touch)
        )
        self._force = _plot(gui, is_seen=may_touch)
        self._waiting = gui.add_html("", visible=False)
        if may_touch:
            self._add_controls(gui)

    def _add_controls(self, gui: GuiApi) -> None:
        browser = self._browser
        self._names = [tool.name for tool in browser.site.tools]
        self._tool = gui.add_dropdown("Tool", self._names, initial_value=browser.tool.name)
        self._tool.on_update(browser.guarded("toucher", self._choose_tool))
        home = gui.add_button("Back to the start", color="gray")
        home.on_click(browser.guarded("toucher", self._go_home))
        with gui.add_folder("Where the hand is", expand_by_default=False):
            step = float(10.0 ** np.floor(np.log10(browser.site.facts.diagonal / 200)))
            self._place = [gui.add_number(f"{axis}, m", 0.0, step=step) for axis in "xyz"]
            for field in self._place:  # a field for each: of three in a row seven digits are cut
                field.precision = max(2 - round(np.log10(step)), 2)
                field.on_update(browser.guarded("toucher", self._type_place))
        with gui.add_folder("How it feels", expand_by_default=False):
            if browser.site.is_coupled:
                stiffness = gui.add_slider(
                    "Stiffness, N/m", SOFTEST, STIFFEST, 10.0, browser.stiffness,
                    hint="Of the spring between hand and tool: force for a metre of the hand.",
                )  # fmt: skip
                stiffness.on_update(browser.guarded("toucher", self._stiffen))
            low, high = (round(browser.scale * share, 4) for share in SCALES)
            self._scales = low, high
            scale = gui.add_number(
                "Scale", round(browser.scale, 3), min=low, max=high, step=0.001,
                hint="Metres of the scene for one metre of the hand.",
            )  # fmt: skip
            scale.on_update(browser.guarded("toucher", self._rescale))

    def _choose_tool(self, event: GuiEvent[Any]) -> None:
        browser = self._browser
        is_held = event.target.value == PART and not self._is_of_the_list
        if event.client is None or is_held:  # set by the page, or unchanged
            return
        name = checks.choice_of(event.target.value, self._names, "a tool")
        browser.put_back()
        browser.use_tool(browser.site.tools[self._names.index(name)], browser.hand)

    def _go_home(self, _: object) -> None:
        browser = self._browser
        browser.put_back()
        browser.use_tool(browser.tool)

    def _type_place(self, event: GuiEvent[Any]) -> None:
        if event.client is None:  # set by the page
            return
        browser = self._browser
        position, far = browser.hand[:3].copy(), checks.FARTHEST
        typed = checks.number_of(event.target.value, -far, far, "a place")
        position[self._place.index(event.target)] = typed
        browser.move_hand(checks.row_of(position, browser.hand[3:]))
        browser.drawing.gizmo.position = position

    def _stiffen(self, event: GuiEvent[Any]) -> None:
        self._browser.set_stiffness(
            checks.number_of(event.target.value, SOFTEST, STIFFEST, "a stiffness")
        )

    def _rescale(self, event: GuiEvent[Any]) -> None:
        scale = checks.number_of(event.target.value, *self._scales, "a scale")
        if scale != self._browser.scale:
            self._browser.scale = scale
            self._browser.begin_anew()
            self.show_tool()

    @property
    def _is_of_the_list(self) -> bool:
        """Whether the tool is one of the site's tools, not a part."""
        return self._browser.tool in self._browser.site.tools

    def show_tool(self) -> None:
        """Select the current tool in the list, and fit the plot to its torques."""
        if not hasattr(self, "_tool"):
            return
        browser = self._browser
        options = self._names if self._is_of_the_list else [*self._names, PART]
        self._tool.options = options
        put(self._tool, browser.tool.name if self._is_of_the_list else PART)
        self._force.scales = _scales(HIGHEST * browser.tool.radius / browser.scale)

    def show_hand(self) -> None:
        """Show the hand's position."""
        if hasattr(self, "_place"):
            for field, value in zip(self._place, self._browser.hand[:3].tolist(), strict=True):
                put(field, round(value, field.precision))

    def show_parts(self, n_waiting: int, n_parts: int) -> None:
        """Show the progress of reading shapes, until all are read."""
        self._waiting.visible = n_waiting > 0
        if n_waiting:
            self._waiting.content = note_html(f"{n_parts - n_waiting:,} of {n_parts:,} parts shown")

    def show(
        self, frame: np.void, wrench: NDArray[np.float64], touched: list[Object], now: float
    ) -> None:
        """Show a frame's wrench (6,), N and N m, the touched objects, and the plot."""
        if now - self._shown_at < SHOWN_EVERY:
            return
        self._shown_at = now
        force, torque = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        state = State(int(frame["state"]))
        trouble = ""
        if state & State.IN_OBJECT:
            trouble = "The tool lies in a part: move it free, then it feels."
        elif frame["unknown"]:
            trouble = "Cells are being fetched."
        self._reading.content = self._reading_html(force, torque, touched, trouble, is_held=True)
        history = np.array(self._browser.history)
        if len(history) > 1:
            self._force.data = tuple(last_seconds(history).T)

    def _reading_html(
        self, force: float, torque: float, touched: list[Object], trouble: str, *, is_held: bool
    ) -> str:
        visitor = self._browser.visitor
        who = f"{visitor.name} · {visitor.role}"
        if not is_held:
            return note_html(who) + note_html(
                "You see what others touch. To feel, ask for a token."
            )
        names = "".join(
            f"<div>{swatch(colours.of_object(obj.id))}{escaped(short_name(obj.name))}</div>"
            for obj in touched[:MOST_SAID]
        )
        if len(touched) > MOST_SAID:
            names += f"<div>and {len(touched) - MOST_SAID} more</div>"
        said = f'<div style="color:#c4610a">{escaped(trouble)}</div>' if trouble else ""
        if not trouble and not touched:
            tool = escaped(self._browser.tool.name)
            hint = "" if self._browser.has_moved else f": drag the {tool}"
            said = f'<span style="opacity:0.6">Touches nothing{hint}</span>'
        big = "font-size:1.5em;font-weight:600;font-variant-numeric:tabular-nums;white-space:nowrap"
        small = "font-size:0.75em;opacity:0.65"
        limit = limit_text(force, self._browser.drawing.cap)
        return (
            f'<div style="margin:4px 12px 2px"><div style="{small}">{swatch(self._browser.colour)}'
            f"{escaped(who)}</div>"
            '<div style="display:flex;gap:24px;margin:4px 0">'
            f'<div><div style="{small}"><span>Force</span>{limit}</div>'
            f'<div style="{big}">{force:.2f} N</div></div>'
            f'<div><div style="{small}">Torque</div>'
            f'<div style="{big}">{torque:.3f} N m</div></div></div>'
            '<div style="font-size:0.82em;min-height:3.2em">'
            f"{names}{said}</div></div>"
        )


def last_seconds(history: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (n, 3) of the last `SECONDS`: time before now, force, torque; 0 before the first."""
    rows = history.copy()
    rows[:, 0] -= history[-1, 0]
    rows = rows[rows[:, 0] >= -SECONDS]
    return np.vstack([[-SECONDS, 0.0, 0.0], [rows[0, 0], 0.0, 0.0], rows])


def _css(colour: colours.Colour) -> str:
    return f"rgb({colour[0]},{colour[1]},{colour[2]})"


def _scales(top: float) -> "dict[str, Scale]":
    """Scales of the plot; top : greatest torque, N m."""
    return {
        "x": {"time": False, "min": -SECONDS, "max": 0.0},
        "y": {"auto": False, "min": 0.0, "max": HIGHEST},
        "torque": {"auto": False, "min": 0.0, "max": top},
    }


def _plot(gui: GuiApi, *, is_seen: bool) -> "GuiUplotHandle":
    """Add the plot of force and torque, each on an axis of its own."""
    return gui.add_uplot(
        (np.array([-SECONDS, 0.0]), np.zeros(2), np.zeros(2)),
        (
            Series(label="s"), Series(label="N", stroke=_css(colours.FORCE), width=2),
            Series(label="N m", stroke=_css(colours.TORQUE), width=2, scale="torque"),
        ),
        title="Force, N (left); torque, N m (right)",
        scales=_scales(1.0),
        axes=(
            Axis(space=60, size=32), Axis(size=40),
            Axis(size=46, scale="torque", side=1, grid={"show": False}),
        ),
        legend=Legend(show=False), height=130, visible=is_seen,
    )  # fmt: skip
