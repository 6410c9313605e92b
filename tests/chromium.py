"""Chromium for tests: Debian's, without a window, drawing in software; every wait has an end."""

import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Browser, Locator, Page, ViewportSize, sync_playwright

from hapticdb.page.scene.surroundings import FIELD_OF_VIEW, View

Floats = NDArray[np.float64]

EXECUTABLE = "/usr/bin/chromium-headless-shell"
"""The shell, not the browser: that one at times never gave a picture of a page it did not show."""
ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # the page's own layers would be drawn in software WebGL, too
    "--disable-gpu-vsync",
]
"""What makes it draw in software, and as little of it as possible."""
SIZE: ViewportSize = {"width": 800, "height": 480}
"""Size of a page. Larger: drawing in software takes longer, about as its area."""
FULL_RESOLUTION = """
if (!new URLSearchParams(location.search).has("token"))
    history.replaceState(null, "", location.pathname + "?fixedDpr=1")
"""
"""Run before the page's own code. Else viser draws fewer pixels where it finds that it is slow, and
two pictures of the same scene differ."""
TIMEOUT = 120.0
"""Seconds that any wait lasts at most: drawing in software is slow on a busy machine."""


@contextmanager
def chromium() -> Iterator[Browser]:
    """Run Chromium; a missing one fails the test."""
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=EXECUTABLE, args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


def new_page(browser: Browser, address: str) -> Page:
    """Open an address as a person of its own does: no cookie is shared; drawn with all pixels."""
    page = browser.new_context(viewport=SIZE).new_page()
    page.add_init_script(FULL_RESOLUTION)
    page.set_default_timeout(1000.0 * TIMEOUT)
    page.goto(address)
    return page


def until(holds: Callable[[], bool], what: str, page: Page) -> None:
    """Wait until something holds, and let the page go on meanwhile."""
    end = time.monotonic() + TIMEOUT
    while not holds():
        assert time.monotonic() < end, (
            f"{what}: not within {TIMEOUT:g} s; the page says: "
            + (page.locator("body").inner_text()[-600:])
        )
        page.wait_for_timeout(100)


def close_notes(page: Page) -> None:
    """Close all notifications, such as viser's of drawing in software."""
    page.evaluate(
        "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
    )


def force_on(page: Page) -> float | None:
    """Force that the tab Touch shows, newtons; None if it shows none."""
    found = re.search(r"Force\D*([\d.]+) N", page.locator("body").inner_text())
    return None if found is None else float(found.group(1))


def field(page: Page, label: str) -> Locator:
    return page.locator(f"xpath=//*[text()='{label}']/following::input[1]")


def hand_fields(page: Page) -> list[Locator]:
    """Three fields of the hand's place, in its opened folder."""
    return [field(page, f"{axis}, m") for axis in "xyz"]


class Eye:
    """Where a page that was not turned shows places of the scene, in its pixels.

    view : its first view; up : number of the axis that points up.
    """

    def __init__(self, page: Page, view: View, up: int) -> None:
        canvas = page.locator("canvas").first.bounding_box()
        assert canvas is not None
        ahead = view.look_at - view.position
        self._ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(self._ahead, np.eye(3)[up])
        self._right = right / np.linalg.norm(right)
        self._over = np.cross(self._right, self._ahead)
        self._place = view.position
        self._middle = (canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2)
        self._length = 0.5 * canvas["height"] / np.tan(FIELD_OF_VIEW / 2)

    def pixels_a_metre(self, place: Floats) -> float:
        """Pixels of a metre across the view at a place (3,), metres."""
        return float(self._length / ((place - self._place) @ self._ahead))

    def pixel(self, place: Floats) -> tuple[float, float]:
        """Pixel of a place (3,), metres."""
        way, share = place - self._place, self.pixels_a_metre(place)
        x, y = self._middle
        return float(x + share * (way @ self._right)), float(y - share * (way @ self._over))


def picture(page: Page, name: str, folder: Path) -> Floats:
    """Take a picture (height, width, 3) of a page; HAPTICDB_TEST_PICTURES names another folder."""
    path = Path(os.environ.get("HAPTICDB_TEST_PICTURES") or folder) / f"{name}.png"
    taken = page.screenshot(path=path)
    image = iio.imread(taken, extension=".png")
    return np.asarray(image[..., :3], dtype=np.float64)
