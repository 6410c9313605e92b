"""Messages that pass the relay, with values that no widget has: no traceback, and others go on."""

import contextlib
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from hapticdb.server.access import Role
from hapticdb.server.limits import Limits
from hapticdb.server.messages import judged
from hapticdb.server.running import Serving
from page_person import PagePerson
from pages import two_parts
from serving import TOKENS, Running, running, urls, wrong_messages

MOST_CAME = 40
"""Connections that send all of it; each is closed after its share of nonsense."""
LAST = "Save a picture"
"""Label of the last widget of the page; it asks the browser for a picture, so it is left alone."""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return two_parts(tmp_path)


def puts(server: Running, role: Role, n_widgets: int) -> int:
    """Send wrong values to all widgets; whoever is closed comes again. How many came."""
    left = list(product(range(n_widgets), range(len(wrong_messages("")))))
    n_came = 0
    while left and n_came < MOST_CAME:
        n_came += 1
        with server.browser(role) as browser, contextlib.suppress(ConnectionClosed):
            person = PagePerson(browser)
            person.find(LAST)
            known = [u for u, one in person.widgets.items() if one.get("label") != LAST]
            while left:
                number, kind = left.pop()
                if number < len(known):
                    person.send(wrong_messages(known[number])[kind])
                if not kind % 4:
                    person.look(0.002)
            person.look(0.5)
    assert not left
    return n_came


@pytest.mark.parametrize("role", [Role.VIEWER])
def test_wrong_values_of_widgets_write_no_traceback(
    scene: Path, role: Role, capfd: pytest.CaptureFixture[str]
) -> None:
    limits = replace(Limits(), browsers_at_once=1000.0, messages_per_second=1e4,
                     messages_at_once=1e4)  # fmt: skip
    with running(Serving(urls(scene), tokens=TOKENS, limits=limits)) as server:
        with server.browser(role) as browser:
            person = PagePerson(browser)
            person.find(LAST)
            n_widgets = len(person.widgets)
        assert puts(server, role, n_widgets) > 1  # some were closed
        assert server.ask("/healthz")[0].status == 200
        with server.browser(role) as browser:
            PagePerson(browser).find(LAST)
    written = "".join(capfd.readouterr())
    assert "Traceback" not in written, written
    assert "never retrieved" not in written
    assert "cannot be taken in" in written


def test_all_of_these_messages_pass_the_relay() -> None:
    import msgspec  # noqa: PLC0415

    for message in wrong_messages("a"):
        assert judged(msgspec.msgpack.encode(message), Role.VIEWER).passed is not None, message
