"""Tab Parts: tree, properties, visibility, distances, and moves of parts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi, GuiEvent

from hapticdb.batches.exact import MET, Distance
from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.page import checks, colours, tools
from hapticdb.page.browser import Browser
from hapticdb.page.panels.jobs import PanelJob
from hapticdb.page.panels.move_controls import MoveControls
from hapticdb.page.panels.tree import PartTree
from hapticdb.page.wording import note_html, rows_html, short_name, size_text
from hapticdb.pointshell.shell import PointShell
from hapticdb.units import length_text

Floats = NDArray[np.float64]

MOST_VOXELS = 60_000
"""Greatest number of voxels drawn of a part; of a larger part, every n-th."""
ACTS = ("Hide", "Show", "Isolate", "See-through", "Show all", "Choose none")
CHOOSE = "Click a part, or press its name. Ctrl and a click add one."


class PartsPanel:
    """Selection of parts; their visibility, collision and distances in this browser."""

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
        self._browser = browser
        self._client = browser.client
        self._ends: list[Floats] = []
        self._voxels: Any = None
        guard = browser.guarded
        with gui.add_folder("Chosen"):
            self._what = gui.add_html(note_html(CHOOSE))
            gui.add_button_group("", ACTS).on_click(guard("viewer", self._show_or_hide))
            self._voxel_box = gui.add_checkbox("Voxels", initial_value=False)
            self._voxel_box.on_update(guard("viewer", self._show_voxels))
            take = gui.add_button(
                "Take this part in hand", visible=browser.visitor.may("toucher"),
                hint="The part becomes your tool: feel whether it comes out.",
            )  # fmt: skip
            take.on_click(guard("toucher", self._take_out))
            self._back = gui.add_button("Put it back", visible=False)
            self._back.on_click(guard("toucher", lambda _: browser.put_back()))
        with gui.add_folder("Distance", expand_by_default=False):
            between = gui.add_button("Measure between two chosen parts")
            between.on_click(guard("viewer", lambda _: self.measure()))
            self._measures = gui.add_checkbox("Measure between two clicks", initial_value=False)
            self._measures.on_update(guard("viewer", self._start_measuring))
            self._work = PanelJob(browser, gui, "a measurement", "parts")
        self.moving = MoveControls(browser, gui)
        self._tree = PartTree(browser, gui, self._toggle)

    def show_objects(self) -> None:
        """Update the tree and the selection."""
        self._tree.show()
        self._say_chosen()

    def clicked(self, origin: Floats, direction: Floats, *, adds: bool) -> None:
        """Select the first part along a ray and name it, or use the point as a distance's end."""
        browser = self._browser
        hit = browser.scene.pick(origin, direction)
        if self._measures.value:
            if hit is not None:
                self._add_end(hit.point)
        elif hit is None:
            self.choose(())
        else:
            self._toggle((hit.id,)) if adds else self.choose((hit.id,))
            self._client.scene.add_label(
                "/named", short_name(browser.site.objects[hit.id].name),
                position=tuple(hit.point), anchor="bottom-center",
            )  # fmt: skip

    def _toggle(self, ids: Sequence[int]) -> None:
        """Add objects to the selection; remove them if all are in it."""
        chosen = self._browser.chosen
        added = [i for i in ids if i not in chosen]
        self.choose((*chosen, *added) if added else [i for i in chosen if i not in ids])

    def choose(self, ids: Sequence[int]) -> None:
        """Highlight objects, and show their properties."""
        browser = self._browser
        browser.chosen = tuple(i for i in ids if i in browser.site.objects)
        browser.scene.highlight(browser.chosen)
        self._client.scene.remove_by_name("/named")
        self.show_objects()
        self.moving.follow()
        if self._voxel_box.value:
            self._draw_voxels()

    def _say_chosen(self) -> None:
        chosen = self._browser.chosen_objects()
        if not chosen:
            said = note_html(CHOOSE)
        elif len(chosen) == 1:
            obj = chosen[0]
            rows = [("Part", short_name(obj.name, 80)), ("Size", size_text(obj))]
            rows += [("Voxels", f"{obj.voxels:,}"), ("File", obj.link.rpartition("/")[2] or "none")]
            said = rows_html([*rows, ("Id", str(obj.id))])
        else:
            total = sum(obj.voxels for obj in chosen)
            said = rows_html((("Parts", f"{len(chosen):,}"), ("Voxels", f"{total:,}")))
        self._what.content = said

    def _show_or_hide(self, event: GuiEvent[Any]) -> None:
        browser = self._browser
        word = checks.choice_of(event.target.value, ACTS, "what to show")
        scene, chosen = browser.scene, browser.chosen
        if word == "Choose none":
            self.choose(())
        elif word == "Show all":
            scene.show()
        elif not chosen:
            raise UsageError("choose a part first: click it, or press its name")
        elif word == "Isolate":
            scene.isolate(chosen)
        elif word == "See-through":
            scene.see_through(chosen)
        elif word == "Show":
            scene.show(chosen)
        else:
            scene.hide(chosen)
        if browser.dragged_part is not None:
            scene.hide((browser.dragged_part,))
        browser.filter_changed()
        self._tree.show()

    def _show_voxels(self, event: GuiEvent[Any]) -> None:
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
                # unticked while they were added
                self._clear_voxels()

        self._browser.site.database.submit(centers, draw, self._browser.failed)

    def _take_out(self, _: object) -> None:
        browser = self._browser
        obj = self._browser.only_chosen()

        def hold(found: PointShell) -> None:
            before, browser.dragged_part = browser.dragged_part, obj.id
            if before is not None and before != obj.id:
                browser.scene.show((before,))
            start = np.array([*tools.middle_of(found), 1.0, 0.0, 0.0, 0.0])
            browser.use_tool(tools.from_shell(obj.name, found), start)
            browser.scene.hide((obj.id,))

        # more points than a probe: parts have more and finer edges
        browser.site.database.submit(
            lambda env: env.shell(obj.id, points=1500), hold, browser.failed
        )

    def show_tool(self) -> None:
        """Show the button "Put it back" if a part is dragged."""
        self._back.visible = self._browser.dragged_part is not None

    def measure(self) -> None:
        """Measure between two chosen parts."""
        if len(self._browser.chosen) != 2:
            raise UsageError("choose two parts first: click one, and the other with Ctrl")
        (a, b), url = self._browser.chosen, self._browser.site.url

        def job(_: object) -> Distance:
            with open_environment(url, read_only=True) as env:
                return env.distance(a, b)

        def show(found: Distance) -> None:
            least, most = length_text(found.at_least), length_text(found.at_most)
            meet = found.at_most <= MET
            self._draw_distance(
                found.on_a, found.on_b,
                "they meet" if meet else most if least == most else f"{least} to {most}",
            )  # fmt: skip

        self._work.begin(job, show)

    def _start_measuring(self, event: GuiEvent[Any]) -> None:
        checks.flag_of(event.target.value, "measuring")
        self._ends = []
        self._browser.scene.clear_measure()
        self._work.said.content = note_html("Click two places.")

    def _add_end(self, point: Floats) -> None:
        self._ends = [*self._ends, point] if len(self._ends) == 1 else [point]
        if len(self._ends) == 1:
            self._work.said.content = note_html("Click the second place.")
            return
        start, end = self._ends
        self._draw_distance(start, end, length_text(float(np.linalg.norm(end - start))))

    def _draw_distance(self, start: Floats, end: Floats, words: str) -> None:
        self._browser.scene.measure(start, end, words)
        along = " / ".join(length_text(float(x)) for x in np.abs(end - start))
        self._work.said.content = rows_html((("Distance", words), ("Along x / y / z", along)))
