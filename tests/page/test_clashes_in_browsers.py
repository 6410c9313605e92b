"""The tab Clashes in Chromium: a pair is found, shown and accepted."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from assemblies import row_of_boxes
from chromium import chromium, close_notes, field, new_page, picture, until
from hapticdb.clashes.run import find_clashes
from hapticdb.kernels.compiling import compile_missing, entries_for
from hapticdb.page import colours
from hapticdb.server.access import Role
from hapticdb.server.served import Serving
from serving import TOKENS, running, urls

pytestmark = pytest.mark.browser

DARKEST = 60.0
"""Least length of a colour that counts: black has every hue."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Four cubes in a row, each a millimetre in the next."""
    compile_missing(entries_for("host", "clashes"))
    return row_of_boxes(tmp_path / "row.db", 4, 0.099)


def pixels_of(image: NDArray[np.float64], hue: int) -> int:
    """Pixels of the scene, left of the panel, whose colour has one of a pair's hues."""
    image = image[:, :440]
    wanted = np.array(colours.PAIR[hue], dtype=np.float64)
    wanted /= np.linalg.norm(wanted)
    lengths = np.linalg.norm(image, axis=-1)
    return int(((image @ wanted > 0.985 * lengths) & (lengths > DARKEST)).sum())


def test_an_editor_finds_a_pair_sees_it_and_accepts_it(path: Path, tmp_path: Path) -> None:
    tokens = {role: token for token, role in TOKENS.items()}
    with running(Serving(urls(path), tokens=TOKENS)) as server, chromium() as browser:
        page = new_page(browser, f"{server.address}?token={tokens[Role.EDITOR]}")
        page.get_by_role("tab", name="Clashes").click()
        page.get_by_role("button", name="Look for clashes").click()
        page.get_by_text("Within 1 mm: 3 overlapping").wait_for()
        field(page, "Words").fill("cube1 cube0")
        page.get_by_text("1 of 3 pairs").wait_for()
        close_notes(page)
        assert pixels_of(picture(page, "1-found", tmp_path), 1) < 1500  # of the gizmo
        field(page, "Pairs").click()
        page.get_by_role("option").nth(1).click()
        page.get_by_role("button", name="Show", exact=True).click()
        page.get_by_text("Orange").wait_for()

        def is_shown() -> bool:
            image = picture(page, "2-shown", tmp_path)
            return min(pixels_of(image, 0), pixels_of(image, 1)) > 3000

        until(is_shown, "both parts are seen in their colours", page)
        field(page, "Because").fill("welded")
        page.get_by_role("button", name="Accept", exact=True).click()
        page.get_by_text("the pair is accepted").wait_for()
        page.get_by_text("0 of 3 pairs").wait_for()
    with hapticdb.open(path, read_only=True) as env:
        told = {one[:2]: (one.status, one.because) for one in find_clashes(env).pairs}
    assert told[1, 2] == ("accepted", "welded")
    assert told[2, 3] == ("same", None)
