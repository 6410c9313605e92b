"""viser's page works in a real browser under the content security policy."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import ConsoleMessage, Page

from chromium import chromium, until
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
WORDS = ["Save Canvas", "Drop a panel here", "Inactive"]
"""Words of viser's own, each in an element of its own."""
WATCHING = (
    f"const WORDS = {WORDS}"
    """
window.own = {}
window.cover = () => getComputedStyle(document.body, "::after").content
setInterval(() => {
    if (!document.body) return
    window.was_covered ||= cover().includes("Connecting ...")
    for (const one of document.querySelectorAll("span, p, div")) {
        if (one.children.length || !WORDS.includes(one.textContent)) continue
        const is_seen = one.checkVisibility({visibilityProperty: true}) && cover() === "none"
        own[one.textContent] = own[one.textContent] || is_seen
    }
}, 5)
"""
)
"""Notes which of viser's own words were part of the page, and whether a person saw them; `cover`
is what the page shows over everything."""
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


def test_view_chromium_content_security_policy(server: Running, page: Page) -> None:
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
    until(lambda: len(page.evaluate("own")) == len(WORDS), "viser's own words are there", page)
    assert page.evaluate("own") == dict.fromkeys(WORDS, False)
    assert page.evaluate("cover()") == "none"
    cookies = page.context.cookies()
    assert [(c["httpOnly"], c["sameSite"]) for c in cookies] == [(True, "Strict")]
    assert complaints == []
    assert token not in page.url
    assert page.evaluate(INJECTED) is None
    assert complaints != []


def test_view_chromium_connection_overlay(environment: Path, page: Page) -> None:
    page.add_init_script(WATCHING)
    with running(Serving(urls(environment), tokens=TOKENS, page="viser_page:work")) as server:
        page.goto(f"{server.address}?token={next(iter(TOKENS))}", timeout=LONG)
        page.get_by_text(" is a ").wait_for(timeout=LONG)
        until(lambda: page.evaluate("cover()") == "none", "the page is seen", page)
        assert page.evaluate("was_covered")
    until(lambda: "server has ended" in page.evaluate("cover()"), "its end is told", page)


def test_view_chromium_sign_in_form(server: Running, page: Page) -> None:
    page.goto(server.address, timeout=LONG)
    page.get_by_label("Token").fill("not-the-right-token")
    page.get_by_role("button").click()
    page.get_by_text("That token is wrong.").wait_for(timeout=LONG)
    page.get_by_label("Token").fill("a-token-for-viewer")
    page.get_by_role("button").click()
    page.get_by_text("is a viewer").wait_for(timeout=LONG)
