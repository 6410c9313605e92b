"""Tab Parts: search, properties, visibility, distances, and moves of parts."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import UsageError
from hapticdb.page import checks, colours, tools
from hapticdb.page.browser import Browser
from hapticdb.page.panels.moving import MovingControls
from hapticdb.page.scene.names import assemblies_of, found_ids
from hapticdb.page.widgets import put
from hapticdb.page.wording import note_html, plain_name, rows_html, short_name, size_text
from hapticdb.pointshell.shell import PointShell
from hapticdb.units import length_text

if TYPE_CHECKING:
    from viser import GuiApi, GuiEvent

Floats = NDArray[np.float64]

NOTHING = "choose from the list"
"""First line of the list."""
MOST_LISTED = 1_000
"""Greatest length of the list. Larger: slower to open in a browser."""
LONGEST_SEARCH = 200
"""Greatest length of a search, characters."""
MOST_VOXELS = 60_000
"""Greatest number of voxels drawn of a part; of a larger part, every n-th. Larger: more is sent."""


class PartsPanel:
    """Search and selection of parts; visibility and collision of parts in this browser."""

    def __init__(self, browser: Browser, gui: "GuiApi") -> None:
        self._browser = browser
        self._client = browser.client
        self._lines: dict[str, tuple[int, ...]] = {}
        self._ends: list[Floats] = []
        self._voxels: Any = None
        guard = browser.guarded
        self._search = gui.add_text("Search", "", hint="Parts of a name, in any order.")
        self._search.on_update(guard("viewer", self._searched))
        self._where = gui.add_html("")
        self._list_of = gui.add_dropdown("Parts", (NOTHING,), initial_value=NOTHING)
        self._list_of.on_update(guard("viewer", self._pick))
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

    def show_objects(self) -> None:
        """Update the list and the selection."""
        self._list()
        self._say_chosen()

    def _list(self) -> None:
        objects = self._browser.site.objects
        search, hidden = self._search.value.strip(), self._browser.scene.hidden
        names = {i: obj.name for i, obj in objects.items()}
        found: list[tuple[str, tuple[int, ...]]]
        if search:
            found = [(names[i], (i,)) for i in found_ids(names, search[:LONGEST_SEARCH])]
        else:
            found = [
                (f"▸ {path} ({len(ids):,} parts)", tuple(ids))
                for path, ids in assemblies_of(names).items()
            ]
            found += [(name, (i,)) for i, name in sorted(names.items(), key=lambda one: one[::-1])]
        self._lines = {}
        for name, ids_of in found[:MOST_LISTED]:
            label = plain_name(name)
            if label in self._lines:
                label = f"{label} [{ids_of[0]}]"
            self._lines[label + (" (hidden)" if hidden.issuperset(ids_of) else "")] = ids_of
        more = f", {MOST_LISTED:,} listed" if len(found) > MOST_LISTED else ""
        n_found = len(found) if search else len(objects)
        self._where.content = note_html(f"{n_found:,} of {len(objects):,} parts{more}")
        self._list_of.options = (NOTHING, *self._lines)
        put(self._list_of, NOTHING)

    def _searched(self, event: "GuiEvent[Any]") -> None:
        checks.text_of(event.target.value, LONGEST_SEARCH, "a search")
        self._list()

    def _pick(self, event: "GuiEvent[Any]") -> None:
        if event.client is not None and event.target.value != NOTHING:
            label = checks.choice_of(event.target.value, tuple(self._lines), "a part")
            self.choose(self._lines[label])

    def clicked(self, origin: Floats, way: Floats) -> None:
        """Select the first part along a ray, or use the point as an end of a distance."""
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
        """Highlight objects, and show their properties."""
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
            if not is_wanted():  # cleared, or another part chosen, meanwhile
                return
            middle = self._browser.drawing.middle
            self._voxels = self._client.scene.add_point_cloud(
                "/voxels", places - middle, colours.of_object(obj.id), point_shape="square",
                point_size=0.9 * self._browser.site.facts.voxel_size, precision="float32",
                position=middle,
            )  # fmt: skip
            if not self._voxel_box.value:
                self._clear_voxels()

        self._browser.site.database.ask(centers, draw, self._browser.failed)

    def _take_out(self, _: object) -> None:
        browser = self._browser
        obj = self._browser.only_chosen()

        def shell(env: Environment) -> PointShell:
            return env.shell(obj.id, points=tools.PART_POINTS)

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
        """Show the button "Put it back" if a part is dragged."""
        self._back.visible = self._browser.taken is not None

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
