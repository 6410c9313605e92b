"""What a person may do, and where recordings may be."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hapticdb.errors import UsageError
from hapticdb.page.browser import Browser
from hapticdb.page.connection import ROLES, Visitor
from hapticdb.page.site import checked_file
from hapticdb.page.wording import error_text


def browser_of(role: str) -> tuple[Browser, list[tuple[str, str]]]:
    """Make a browser without viser that keeps what it would tell its person."""
    browser = Browser.__new__(Browser)
    told: list[tuple[str, str]] = []

    def note(title: str, text: str, **_: object) -> None:
        told.append((title, text))

    browser.visitor = Visitor("Ada", role)
    browser.client = SimpleNamespace(client_id=3, add_notification=note)  # type: ignore[assignment]
    browser.site = SimpleNamespace(  # type: ignore[assignment]
        error_text=lambda error: error_text(error, ()),
        server=SimpleNamespace(get_clients=lambda: {3: browser.client}),
    )
    browser._is_closed = False
    return browser, told


@pytest.mark.parametrize("has", ROLES)
@pytest.mark.parametrize("needs", ROLES)
def test_guarded_callback_by_role(has: str, needs: str) -> None:
    browser, told = browser_of(has)
    done: list[object] = []
    browser.guarded(needs, done.append)("event")
    may = ROLES.index(has) >= ROLES.index(needs)
    assert done == (["event"] if may else [])
    assert bool(told) != may
    if told:
        assert needs in told[0][1]


def test_guarded_error_message_names_nothing() -> None:
    browser, told = browser_of("editor")

    def refuse(_: object) -> None:
        raise UsageError("a length: give a number from 0 to 1")

    def fail(_: object) -> None:
        raise RuntimeError("/secret/path")

    browser.guarded("viewer", refuse)("event")
    browser.guarded("viewer", fail)("event")
    assert told[0] == ("Not done", "a length: give a number from 0 to 1")
    assert "/secret" not in told[1][1]


@pytest.mark.parametrize("name", ["", ".", "..", "../a.hdbrec", "/a.hdbrec", "a/b.hdbrec", ".a"])
def test_checked_file_inside_folder(tmp_path: Path, name: str) -> None:
    assert checked_file(tmp_path, "a.hdbrec") == tmp_path / "a.hdbrec"
    with pytest.raises(UsageError):
        checked_file(tmp_path, name)
    with pytest.raises(UsageError, match="--recordings"):
        checked_file(None, "a.hdbrec")


def test_guarded_closed_browser_silent(
    caplog: pytest.LogCaptureFixture,
) -> None:
    browser, told = browser_of("viewer")
    browser.site.server.get_clients = dict  # type: ignore[method-assign]

    def fail(_: object) -> None:
        raise RuntimeError("no such client")

    with caplog.at_level("INFO"):
        browser.guarded("viewer", fail)("event")
    assert [(one.levelname, one.exc_info) for one in caplog.records] == [("INFO", None)]
    browser._is_closed = True
    browser.guarded("viewer", fail)("event")
    assert len(caplog.records) == 1
    assert not told
