"""Browsers reach the page through the relay, and only what the page uses goes through."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hapticdb.server.access import Role
from hapticdb.server.running import Serving
from serving import CAMERA, TOKENS, Running, running, sent, text_until, urls


@pytest.fixture(scope="module", params=["", "/hapticdb"])
def server(request: pytest.FixtureRequest, environment: Path) -> Iterator[Running]:
    serving = Serving(
        urls(environment), tokens=TOKENS, prefix=request.param, page="viser_page:work"
    )
    with running(serving) as found:
        yield found


def test_a_browser_sees_the_page_and_moves_its_widgets(server: Running) -> None:
    with server.browser(Role.EDITOR) as browser:
        sent(browser, CAMERA)
        seen = text_until(browser, "is a editor")
        assert "nothing yet" in seen or "slider" in seen
