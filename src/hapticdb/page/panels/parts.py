"""The tab Parts: a tree with search, what a part is, what is shown, distances, moving a part."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import UsageError
from hapticdb.page import checks, colours, tools
from hapticdb.page.browser import Browser
from hapticdb.page.panels.moving import MovingControls
from hapticdb.page.scene.names import Branch
from hapticdb.page.wording import note_html, plain_name, rows_html, short_name, size_text
from hapticdb.pointshell.shell import PointShell
from hapticdb.units import length_text

if TYPE_CHECKING:
    from viser import GuiApi, GuiEvent

Floats = NDArray[np.float64]

LIGHT = (226, 232, 240)
"""Colour of the lines of the tree."""
N_LINES = 8
"""Lines of a page of the tree. Larger: fewer pages, and a longer panel."""
LONGEST_SEARCH = 200
"""Letters of a search. Larger: longer texts of a client are compared with every name."""
MOST_VOXELS = 60_000
"""Voxels that are shown of a chosen part; of a larger part, every n-th. Larger: more is sent."""


@dataclass(frozen=True)
class _TreeLine:
    """One line of the tree: a sub-assembly, or an object where `branch` is None."""

    label: str
    ids: tuple[int, ...]
    branch: Branch | None = None


class PartsPanel:
    """Finds parts, says what they are, and sets what this browser shows and feels.

    gui : where the panel is made, inside the present container.
    """

    def __init__(self, browser: Browser, gui: "GuiApi") -> None:
        self._browser = browser
        self._client = browser.client
        self._opened = ""
        self._page = 0
        self._lines: list[_TreeLine] = []
        self._ends: list[Floats] = []
        self._voxels: Any = None
        guard = browser.guarded
        self._search = gui.add_text("Search", "", hint="Parts of a name, in any order.")
        self._search.on_update(guard("viewer", self._searched))
        self._where = gui.add_html("")
        self._up = gui.add_button("Up", color="gray", visible=False)
        self._up.on_click(guard("viewer", self._go_up))
        self._buttons = []
        for number in range(N_LINES):
            button = gui.add_button(" ", color=LIGHT, visible=False)
            button.on_click(guard("viewer", partial(self._press, number)))
            self._buttons.append(button)
        self._turn = gui.add_button_group("Page", ("Before", "Next"), visible=False)
        self._turn.on_click(guard("viewer", self._turn_page))
        with gui.add_folder("Chosen"):
            self._what = gui.add_html(note_html("Click a part, or choose one above."))
            self._act = gui.add_button_group("Show", ("Hide", "Isolate", "Show all"))
            self._act.on_click(guard("viewer", self._show_or_hide))
            colour = gui.add_rgb("Colour", colours.HELD)
            colour.on_update(guard("viewer", self._colour))
            voxels = gui.add_checkbox("Voxels", initial_value=False)
            voxels.on_update(guard("viewer", self._show_voxels))
            self._voxel_box = voxels
            may_touch = browser.visitor.may("toucher")
            self._take = gui.add_button(
                "Take this part in hand", visible=may_touch,
                hint="The part becomes your tool: feel whether it comes out.",
            )  # fmt: skip
            self._take.on_click(guard("toucher", self._take_out))
            self._back = gui.add_button("Put it back", visible=False)
            self._back.on_click(guard("toucher", lambda _: browser.put_back()))
        with gui.add_folder("Distance", expand_by_default=False):
            self._measures = gui.add_checkbox("Measure between two clicks", initial_value=False)
            self._measures.on_update(guard("viewer", self._start_measuring))
            self._distance = gui.add_html(note_html("Tick the box, then click two places."))
        self.moving = MovingControls(browser, gui)
        self.show_objects()

    # -- the tree ----------------------------------------------------------------------------

    def show_objects(self) -> None:
        """Show the tree as the objects are now."""
        self._list()
        self._say_chosen()

    def _list(self) -> None:
        site = self._browser.site
        search = self._search.value
        if search.strip():
            ids = site.view.search(search[:LONGEST_SEARCH])
            lines = [
                _TreeLine(plain_name(site.objects[i].name), (i,)) for i in ids if i in site.objects
            ]
            where = f"{len(ids):,} of {len(site.objects):,} parts"
        else:
            branch = _branch_at(site.view.tree(), self._opened)
            self._opened = branch.path
            lines = [
                _TreeLine(f"▸ {below.name} ({below.count})", tuple(below.all_ids()), below)
                for below in branch.branches
            ]
            lines += [
                _TreeLine(site.objects[i].name.rpartition("/")[2], (i,))
                for i in branch.ids
                if i in site.objects
            ]
            where = f"{branch.path or 'All parts'} · {branch.count:,}"
        n_pages = max(1, -(-len(lines) // N_LINES))
        self._page = min(max(self._page, 0), n_pages - 1)
        self._lines = lines[self._page * N_LINES : (self._page + 1) * N_LINES]
        pages = f" · page {self._page + 1} of {n_pages}" if n_pages > 1 else ""
        self._where.content = note_html(short_name(where, 60) + pages)
        self._up.visible = bool(self._opened) and not search.strip()
        self._turn.visible = n_pages > 1
        hidden = self._browser.scene.hidden
        for button, line in zip(self._buttons, self._lines, strict=False):
            sign = " (hidden)" if hidden.issuperset(line.ids) else ""
            button.label = short_name(line.label) + sign
            button.visible = True
        for button in self._buttons[len(self._lines) :]:
            button.visible = False

    def _searched(self, event: "GuiEvent[Any]") -> None:
        checks.text_of(event.target.value, LONGEST_SEARCH, "a search")
        self._page = 0
        self._list()

    def _turn_page(self, event: "GuiEvent[Any]") -> None:
        word = checks.choice_of(event.target.value, ("Before", "Next"), "a page")
        self._page += 1 if word == "Next" else -1
        self._list()

    def _go_up(self, _: object) -> None:
        self._opened = self._opened.rpartition("/")[0]
        self._page = 0
        self._list()

    def _press(self, number: int, _: object) -> None:
        if number >= len(self._lines):
            return
        line = self._lines[number]
        if line.branch is not None:
            self._opened = line.branch.path
            self._page = 0
            self._list()
        self.choose(line.ids)

    # -- the chosen parts --------------------------------------------------------------------

    def clicked(self, origin: Floats, way: Floats) -> None:
        """Choose what a ray meets; or take it as an end of a distance."""
        browser = self._browser
        met = browser.scene.pick(origin, way)
        if met is None:
            if not self._measures.value:
                self.choose(())
            return
        if self._measures.value:
            self._add_end(met.point)
        else:
            self.choose((met.id,))

    def choose(self, ids: Sequence[int]) -> None:
        """Mark objects, and say what they are."""
        browser = self._browser
        browser.chosen = tuple(i for i in ids if i in browser.site.objects)
        browser.scene.highlight(browser.chosen)
        self._say_chosen()
        self.moving.follow()
        if self._voxel_box.value:
            self._draw_voxels()

    def _say_chosen(self) -> None:
        chosen = self._browser.chosen_objects()
        if not chosen:
            said = note_html("Click a part, or choose one above.")
        elif len(chosen) == 1:
            obj = chosen[0]
            said = rows_html(
                (
                    ("Part", short_name(obj.name, 80)),
                    ("Size", size_text(obj)),
                    ("Voxels", f"{obj.voxels:,}"),
                    ("File", obj.link.rpartition("/")[2] or "none"),
                    ("Id", str(obj.id)),
                )
            )
        else:
            total = sum(obj.voxels for obj in chosen)
            said = rows_html((("Parts", f"{len(chosen):,}"), ("Voxels", f"{total:,}")))
        self._what.content = said

    def _show_or_hide(self, event: "GuiEvent[Any]") -> None:
        browser = self._browser
        word = checks.choice_of(event.target.value, ("Hide", "Isolate", "Show all"), "what to show")
        scene, chosen = browser.scene, browser.chosen
        if word == "Show all":
            scene.show()
        elif not chosen:
            raise UsageError("choose a part first: click it, or take it from the list")
        elif word == "Isolate":
            scene.isolate(chosen)
        elif scene.hidden.issuperset(chosen):
            scene.show(chosen)
        else:
            scene.hide(chosen)
        if browser.taken is not None:
            scene.hide((browser.taken,))
        browser.filter_changed()
        self._list()

    def _colour(self, event: "GuiEvent[Any]") -> None:
        red, green, blue = checks.numbers_of(event.target.value, 3, 255.0, "a colour")
        browser = self._browser
        browser.scene.colour(browser.chosen, (int(abs(red)), int(abs(green)), int(abs(blue))))

    # -- voxels ------------------------------------------------------------------------------

    def _show_voxels(self, event: "GuiEvent[Any]") -> None:
        if checks.flag_of(event.target.value, "voxels"):
            self._browser.only_chosen()
            self._draw_voxels()
        else:
            self._clear_voxels()

    def _clear_voxels(self) -> None:
        drawn, self._voxels = self._voxels, None
        if drawn is not None:
            drawn.remove()

    def _draw_voxels(self) -> None:
        chosen = self._browser.chosen_objects()
        if len(chosen) != 1:
            self._clear_voxels()
            return
        obj = chosen[0]

        def centers(env: Environment) -> Floats:
            found = env.voxels(obj.id)
            return env.grid.centers(found[:: -(-len(found) // MOST_VOXELS)])

        def is_wanted() -> bool:
            return bool(self._voxel_box.value) and self._browser.chosen == (obj.id,)

        def draw(places: Floats) -> None:
            if not is_wanted():  # the box was cleared, or another part chosen, meanwhile
                return
            self._voxels = self._client.scene.add_point_cloud(
                "/voxels", places, colours.of_object(obj.id), point_shape="square",
                point_size=0.9 * self._browser.site.facts.voxel_size, precision="float32",
            )  # fmt: skip
            if not self._voxel_box.value:
                self._clear_voxels()

        self._browser.site.database.ask(centers, draw, self._browser.failed)

    # -- a part in hand ----------------------------------------------------------------------

    def _take_out(self, _: object) -> None:
        browser = self._browser
        obj = self._browser.only_chosen()
        facts = browser.site.facts
        inset = tools.inset_of(facts.voxel_size, smooth=facts.is_smooth)

        def shell(env: Environment) -> PointShell:
            return env.shell(obj.id, points=tools.PART_POINTS, inset=inset)

        def hold(found: PointShell) -> None:
            before, browser.taken = browser.taken, obj.id
            if before is not None and before != obj.id:
                browser.scene.show((before,))
            middle = tools.middle_of(found)
            browser.take_in_hand(
                tools.from_shell(obj.name, found), np.array([*middle, 1.0, 0.0, 0.0, 0.0])
            )
            browser.scene.hide((obj.id,))

        browser.site.database.ask(shell, hold, browser.failed)

    def show_tool(self) -> None:
        """Show whether a part is in hand."""
        self._back.visible = self._browser.taken is not None

    # -- distances ---------------------------------------------------------------------------

    def _start_measuring(self, event: "GuiEvent[Any]") -> None:
        checks.flag_of(event.target.value, "measuring")
        self._ends = []
        self._browser.scene.clear_measure()
        self._distance.content = note_html("Click two places.")

    def _add_end(self, point: Floats) -> None:
        self._ends = [*self._ends, point] if len(self._ends) == 1 else [point]
        if len(self._ends) == 1:
            self._distance.content = note_html("Click the second place.")
            return
        start, end = self._ends
        distance = length_text(self._browser.scene.measure(start, end))
        along = " / ".join(length_text(float(x)) for x in np.abs(end - start))
        self._distance.content = rows_html((("Distance", distance), ("Along x / y / z", along)))


def _branch_at(root: Branch, path: str) -> Branch:
    """Branch of a path, or the nearest one above it that is still there."""
    found = root
    while found.path != path:
        below = next(
            (b for b in found.branches if path == b.path or path.startswith(f"{b.path}/")), None
        )
        if below is None:
            return found
        found = below
    return found
