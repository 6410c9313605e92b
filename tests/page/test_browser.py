"""Browsers come and go, and none feels what it does not show."""

from types import SimpleNamespace
from typing import Any

import pytest

from hapticdb.page import process
from hapticdb.page.browser import Browser
from hapticdb.page.connection import Visitor


class PretendServer:
    """viser's server as far as `open_page` needs it: connects and disconnects clients."""

    def __init__(self) -> None:
        nothing = SimpleNamespace(
            set_panel_label=lambda *_: None,
            configure_theme=lambda **_: None,
            main_panel=SimpleNamespace(dock_right=lambda: None, set_width=lambda _: None),
        )
        self.gui = nothing
        self.scene = SimpleNamespace(world_axes=SimpleNamespace(visible=True))
        self.clients: dict[int, Any] = {}

    def on_client_connect(self, call: Any) -> None:  # noqa: ANN401 - a callback
        self.connect = call

    def on_client_disconnect(self, call: Any) -> None:  # noqa: ANN401 - a callback
        self.disconnect = call

    def get_clients(self) -> dict[int, Any]:
        return dict(self.clients)


class PretendSite:
    """A site whose workers work at once."""

    def __init__(self) -> None:
        self.server = PretendServer()
        self.title = "a scene"
        self.browsers: dict[int, Any] = {}
        self.numbers: set[int] = set()
        self.forgotten: list[object] = []
        self.view = SimpleNamespace(contents=SimpleNamespace(leave=self.forgotten.append))
        self.workers = SimpleNamespace(submit=lambda work, client: work(client))

    def begin(self) -> None:
        pass

    def leave(self, client: int) -> None:
        if client in self.browsers:
            self.browsers.pop(client).close()

    def take_number(self) -> int:
        self.numbers.add(len(self.numbers))
        return len(self.numbers) - 1

    def free_number(self, number: int) -> None:
        self.numbers.discard(number)


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> PretendSite:
    made = PretendSite()

    class PretendBrowser:
        def __init__(self, site: PretendSite, client: Any, visitor: Visitor, number: int) -> None:  # noqa: ANN401
            self.site, self.client, self.number = site, client, number
            if visitor.name == "leaves":
                site.server.clients.clear()
                site.server.disconnect(client)
            if visitor.name == "breaks":
                raise OSError("no room")

        def close(self) -> None:
            self.site.free_number(self.number)

    monkeypatch.setattr(process, "TabbedBrowser", PretendBrowser)
    return made


def connect(site: PretendSite, name: str) -> None:
    client = SimpleNamespace(client_id=7)
    process.open_page(site, lambda _: Visitor(name, "viewer"))  # type: ignore[arg-type]
    site.server.clients[7] = client
    site.server.connect(client)


def test_a_browser_that_stays_is_known_until_it_leaves(site: PretendSite) -> None:
    connect(site, "stays")
    assert list(site.browsers) == [7]
    assert site.numbers == {0}
    site.server.disconnect(site.server.clients.pop(7))
    assert not site.browsers
    assert not site.numbers


def test_a_browser_that_leaves_or_fails_while_its_panels_are_made_leaves_nothing(
    site: PretendSite,
) -> None:
    connect(site, "leaves")
    with pytest.raises(OSError, match="no room"):
        connect(site, "breaks")
    assert not site.browsers
    assert not site.numbers
    assert site.forgotten == [7]


@pytest.mark.parametrize(
    ("felt_without", "hidden", "n_begun"),
    [([3], {3}, 0), ([3], {3, 7}, 1), ([3, 5], {3}, 0), ([], {7}, 1)],
    ids=["as before", "an unseen one comes", "an unseen one goes", "the first unseen one"],
)
def test_what_is_not_seen_is_not_felt_when_it_comes(
    felt_without: list[int], hidden: set[int], n_begun: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = Browser.__new__(Browser)
    begun: list[bool] = []
    browser.site = SimpleNamespace(objects=dict.fromkeys((1, 3, 7)))  # type: ignore[assignment]
    browser.scene = SimpleNamespace(hidden=hidden)  # type: ignore[assignment]
    browser.chosen, browser.taken, browser._unfelt = (), None, felt_without
    monkeypatch.setattr(browser, "begin_anew", lambda: begun.append(True))
    browser.objects_changed()
    assert len(begun) == n_begun
