"""Browser with the tabs of the panel."""

from typing import Any

from viser import ClientHandle

from hapticdb.page import checks
from hapticdb.page.browser import Browser
from hapticdb.page.connection import Visitor
from hapticdb.page.panels.clashes import ClashPanel
from hapticdb.page.panels.machine import MachinePanel
from hapticdb.page.panels.parts import PartsPanel
from hapticdb.page.panels.record import RecordPanel
from hapticdb.page.panels.sweeps import SweepPanel
from hapticdb.page.panels.touch import TouchPanel
from hapticdb.page.panels.viewing import ViewControls
from hapticdb.page.site import Site


class TabbedBrowser(Browser):
    """Browser with all tabs; parameters as for `Browser`."""

    def __init__(self, site: Site, client: ClientHandle, visitor: Visitor, number: int) -> None:
        super().__init__(site, client, visitor, number)
        gui = client.gui
        self._n_waiting = -1  # parts without a shape yet; -1: never counted
        self.view = ViewControls(self, gui)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Touch"):
            self.touch = TouchPanel(self, gui)
        with tabs.add_tab("Parts"):
            self.parts = PartsPanel(self, gui)
        with tabs.add_tab("Sweep"):
            if site.machine is not None:  # no tab: six have no room for their names
                with gui.add_folder("Machine"):
                    MachinePanel(self, gui, *site.machine)
            SweepPanel(self, gui)
        with tabs.add_tab("Clashes"):
            self.clashes = ClashPanel(self, gui)
        with tabs.add_tab("Record"):
            self.record = RecordPanel(self, gui)
        for modifier in (None, "cmd/ctrl"):
            client.scene.on_click(modifier=modifier)(self.guarded("viewer", self._clicked))
        self.parts.choose(visitor.shown)
        if len(self.chosen) == 2:
            self.parts.measure()
        if visitor.may("toucher"):
            self.use_tool(self.tool)

    def tick(self, now: float) -> None:
        """Show the newest frame, of the session and of a replay."""
        self.record.tick(now)
        self.view.tick(now)
        for work in self.works:
            work.tick()
        contents = self.site.view.contents
        waiting = contents.waiting() if self._n_waiting else 0
        if waiting != self._n_waiting:
            self._n_waiting = waiting
            self.touch.show_parts(waiting, len(contents.records))
        super().tick(now)

    def objects_changed(self) -> None:
        """Update all tabs after a commit; called in the follower's thread."""
        super().objects_changed()
        self.parts.show_objects()
        self.clashes.objects_changed()
        self.parts.moving.renew()

    def close(self) -> None:
        """End the session and remove the tool from every view."""
        self._is_closed = True
        self.parts.moving.leave()
        super().close()

    def _clicked(self, event: Any) -> None:  # noqa: ANN401 - an event of viser
        origin = checks.numbers_of(event.ray_origin, 3, checks.FARTHEST, "a ray")
        direction = checks.numbers_of(event.ray_direction, 3, checks.FARTHEST, "a ray")
        adds = event.modifier is not None
        self.parts.clicked(self.view.seen_from(origin, direction), direction, adds=adds)
