"""Browsers come and go, and none feels what it does not show."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from hapticdb.page import page_process
from hapticdb.page.browser import Browser
from hapticdb.page.connection import Visitor


@pytest.mark.parametrize("fails", [False, True])
def test_browser_closed_or_failed_during_setup(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, client = MagicMock(browsers={}), SimpleNamespace(client_id=7)
    connected = site.server.on_client_connect
    site.server.get_clients.return_value = {}  # it has gone when the panels are made

    def made(*_: object) -> Any:  # noqa: ANN401 - in place of a TabbedBrowser
        if fails:
            raise OSError("no room")
        return MagicMock()

    monkeypatch.setattr(page_process, "TabbedBrowser", made)
    page_process.open_page(site, lambda _: Visitor("Ada", "viewer"))
    (connect,) = connected.call_args.args
    if fails:
        with pytest.raises(OSError, match="no room"):
            connect(client)
        site.free_number.assert_called_once_with(site.take_number())
        site.view.contents.leave.assert_called_once_with(7)
        assert not site.browsers
    else:
        connect(client)
        site.workers.submit.assert_called_once_with(site.leave, 7)


@pytest.mark.parametrize(
    ("felt_without", "hidden", "n_begun"),
    [([3], {3}, 0), ([3], {3, 7}, 1), ([3, 5], {3}, 0), ([], {7}, 1)],
    ids=["as before", "an unseen one comes", "an unseen one goes", "the first unseen one"],
)
def test_browser_objects_changed_restarts_session(
    felt_without: list[int], hidden: set[int], n_begun: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = Browser.__new__(Browser)
    begun: list[bool] = []
    browser.site = SimpleNamespace(objects=dict.fromkeys((1, 3, 7)))  # type: ignore[assignment]
    browser.scene = SimpleNamespace(hidden=hidden, shade=lambda: None)  # type: ignore[assignment]
    browser.chosen, browser.dragged_part, browser._excluded_ids = (), None, felt_without
    monkeypatch.setattr(browser, "begin_anew", lambda: begun.append(True))
    browser.objects_changed()
    assert len(begun) == n_begun
