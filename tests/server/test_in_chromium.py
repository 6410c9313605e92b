"""viser's page works in a real browser under the content security policy."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import ConsoleMessage, Page

from chromium import chromium
from hapticdb.server.access import Role
from hapticdb.server.served import Serving
from serving import TOKENS, Running, running, urls

pytestmark = pytest.mark.browser

INJECTED = """() => {
    const script = document.createElement("script");
    script.textContent = "window.injected = 1";
    document.head.append(script);
    return window.injected ?? null;
}"""
"""Adds a script to the page, as a part's name with markup would."""
WATCHING = """setInterval(() => {
    for (const button of document.querySelectorAll("button")) {
        if (button.textContent !== "Save Canvas") continue;
        window.laid_out = true;
        window.shown ||= button.checkVisibility({visibilityProperty: true});
    }
}, 5)"""
"""Notes whether viser's own settings are part of the page, and whether a person sees them."""
LONG = 30_000.0
"""Longest wait for the page, milliseconds."""


@pytest.fixture(scope="module")
def server(environment: Path) -> Iterator[Running]:
    serving = Serving(urls(environment), tokens=TOKENS, prefix="/hapticdb", page="viser_page:work")
    with running(serving) as found:
        yield found


@pytest.fixture
def page() -> Iterator[Page]:
    with chromium() as browser:
        yield browser.new_page(viewport={"width": 640, "height": 400})


def test_the_view_opens_by_its_link_and_works_under_the_policy(server: Running, page: Page) -> None:
    complaints: list[str] = []

    def hear(message: ConsoleMessage) -> None:
        if "Content Security Policy" in message.text or "violates" in message.text:
            complaints.append(message.text)

    page.on("console", hear)
    token = next(token for token, role in TOKENS.items() if role is Role.EDITOR)
    page.add_init_script(WATCHING)
    page.goto(f"{server.address}?token={token}", timeout=LONG)
    page.get_by_text("is a editor").wait_for(timeout=LONG)
    assert page.locator("canvas").count() >= 1
    box = page.get_by_role("slider").first
    box.focus()
    page.keyboard.press("ArrowRight")
    page.get_by_text("slider 0.6").wait_for(timeout=LONG)
    assert page.evaluate("[window.laid_out, window.shown]") == [True, False]
    cookies = page.context.cookies()
    assert [(c["httpOnly"], c["sameSite"]) for c in cookies] == [(True, "Strict")]
    assert complaints == []
    assert token not in page.url
    assert page.evaluate(INJECTED) is None
    assert complaints != []


def test_a_person_signs_in_by_the_form(server: Running, page: Page) -> None:
    page.goto(server.address, timeout=LONG)
    page.get_by_label("Token").fill("not-the-right-token")
    page.get_by_role("button").click()
    page.get_by_text("That token is wrong.").wait_for(timeout=LONG)
    page.get_by_label("Token").fill("a-token-for-viewer")
    page.get_by_role("button").click()
    page.get_by_text("is a viewer").wait_for(timeout=LONG)
