"""The page in Chromium: one person uses all of it; two feel, see and move the same part."""

import re
import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page

import hapticdb
from children import until as patiently
from chromium import (
    Eye,
    chromium,
    close_notes,
    drag,
    field,
    force_on,
    hand_fields,
    hand_on,
    new_page,
    picture,
    until,
)
from hapticdb.kernels.compiling import compile_missing, entries_for
from hapticdb.page import tools
from hapticdb.page.drawing import HAND_GIZMO
from hapticdb.page.panels.moving import MOVING_GIZMO
from hapticdb.page.process import new_server
from hapticdb.page.scene.picking import Struck
from hapticdb.page.scene.surroundings import framing
from hapticdb.page.scene.view import SceneView
from hapticdb.page.site import SceneFacts
from hapticdb.server.access import Role
from hapticdb.server.served import Serving
from serving import TOKENS, Running, running, urls

pytestmark = pytest.mark.browser

Floats = NDArray[np.float64]

PUSHED = 0.2
"""How deep the hand pushes the ball into the bonnet, in radii of the ball."""
NEAR = 0.06
"""How near the hand gets to where it is dragged, in radii of the ball: a pixel is 0.08."""
GRABBED = 0.7
"""Where an arrow of a gizmo is grabbed, times the gizmo's scale: its head ends at about 1, and the
rings that turn it cross it at other places."""


@pytest.fixture(scope="module")
def imported(test_data: Path | None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    assert test_data is not None, "the real car is needed: give HAPTICDB_TEST_DATA its folder"
    folder = tmp_path_factory.mktemp("car")
    shutil.copy(test_data / "demo_vintage_car" / "vintage_car.glb", folder)
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=9, extent=1.8))
    reports = hapticdb.import_files(folder / "car.db", [folder / "vintage_car.glb"], options)
    assert [report.status for report in reports] == ["imported"]
    compile_missing(entries_for("host", "sweep"))
    return folder / "car.db"


@pytest.fixture
def car(imported: Path, tmp_path: Path) -> Path:
    """The imported car, a copy for each test: one of them moves a part."""
    return Path(shutil.copy(imported, tmp_path))


@pytest.fixture
def server(car: Path, tmp_path: Path) -> Iterator[Running]:
    serving = Serving(urls(car), tokens=TOKENS, title="Vintage car", recordings=str(tmp_path))
    with running(serving) as found:
        yield found


def first_of(view: SceneView, origin: Floats, way: Floats) -> Struck | None:
    return view.contents.pick(origin, way, lambda _: True)


class Aim:
    """The bonnet: on top of the car's front, the broadest part that a ball can touch alone.

    id, name : of the part; contact (3,) : middle of the ball that touches it from above, pushed in;
    seen (3,) : a point of the part that the first view shows; other (3,) : such a point elsewhere;
    middle (3,) : of its box; all metres.
    """

    def __init__(self, view: SceneView, env: hapticdb.Environment) -> None:
        self.facts = facts = SceneFacts.of(view)
        self.framing, self.up = framing(facts.bounds, view.up), view.up
        eye = self.framing.position
        ball = tools.built_in(facts.diagonal, facts.voxel_size, smooth=facts.is_smooth)[0]
        self.radius = ball.radius
        view_middle = facts.bounds.mean(axis=0)
        found: list[tuple[float, int, Floats, Floats]] = []
        for obj in view.objects.values():
            middle = obj.bounds.mean(axis=0)
            top = middle + facts.up * float((obj.bounds[1] - middle) @ facts.up)
            over = first_of(view, top + facts.up * facts.diagonal, -facts.up)
            if over is None or over.id != obj.id or (over.point - view_middle) @ facts.toward < 0.0:
                continue
            place = np.eye(4)
            place[:3, 3] = over.point + facts.up * ((1.0 - PUSHED) * ball.radius)
            seen = first_of(view, eye, over.point - eye)
            if seen is None or seen.id != obj.id:
                continue
            touched = env.touch(ball.shell, place)
            free = env.touch(ball.shell, place, exclude=(obj.id,))
            if [part.id for part in touched.objects] == [obj.id] and not free.objects:
                sides = (obj.bounds[1] - obj.bounds[0])[facts.up == 0.0]
                found.append((float(np.prod(sides)), obj.id, place[:3, 3], over.point))
        assert found, "no part of the car can be touched alone from above"
        _, self.id, self.contact, self.seen = max(found, key=lambda one: one[0])
        elsewhere = first_of(view, eye, view_middle - eye)
        assert elsewhere is not None
        self.other = elsewhere.point
        obj = view.objects[self.id]
        self.name, self.middle = obj.name, obj.bounds.mean(axis=0)


@pytest.fixture
def aim(car: Path) -> Iterator[Aim]:
    viser_server = new_server()
    try:
        with (
            closing(SceneView(viser_server, str(car))) as view,
            hapticdb.open(car, read_only=True) as env,
        ):
            patiently(lambda: view.contents.waiting() == 0)
            yield Aim(view, env)
    finally:
        viser_server.stop()


def opened(page: Page) -> Page:
    """Wait until a page's session runs."""
    page.get_by_text("Touches nothing").wait_for()
    close_notes(page)
    return page


def pull_hand(page: Page, eye: Eye, aim: Aim, to: Floats) -> None:
    """Drag the hand's gizmo by its arrows, level first, then up or down."""
    turn = tools.start_pose(aim.facts.bounds, aim.facts.up, aim.facts.toward, aim.radius, 0)[:3, :3]
    for axis in turn.T:
        for _ in range(3):  # a pixel is a step: the rest is dragged again
            here = hand_on(page)
            left = float((to - here) @ axis)
            if abs(left) < NEAR * aim.radius:
                break
            arrow = axis * (GRABBED * HAND_GIZMO / eye.pixels_a_metre(here))
            drag(page, eye, here + arrow, left * axis)
            until(lambda: not np.array_equal(hand_on(page), here), "the hand moves", page)  # noqa: B023 - called now
    assert np.abs(hand_on(page) - to).max() < 2.0 * NEAR * aim.radius


def around(image: Floats, pixel: tuple[float, float]) -> Floats:
    """Cut the square (24, 24, 3) around a pixel out of a picture."""
    x, y = (round(value) for value in pixel)
    return image[y - 12 : y + 12, x - 12 : x + 12]


def test_one_feels_a_part_until_another_moves_it_away(
    server: Running, aim: Aim, tmp_path: Path
) -> None:
    facts = aim.facts
    links = {role: f"{server.address}?token={token}" for token, role in TOKENS.items()}
    with chromium() as browser:
        ada = opened(new_page(browser, links[Role.TOUCHER]))
        eye = Eye(ada, aim.framing, aim.up)
        ada.get_by_text("Where the hand is").click()
        before = picture(ada, "1-ada-before", tmp_path)

        # one drags the ball into the bonnet, and reads a force
        pull_hand(ada, eye, aim, aim.contact)
        until(lambda: (force_on(ada) or 0.0) > 0.5, "a force is read", ada)
        ada.get_by_text("Force", exact=True).scroll_into_view_if_needed()
        picture(ada, "2-ada-feels", tmp_path)

        # another, who comes now since two pages are drawn half as fast, sees that ball there
        ben = opened(new_page(browser, links[Role.EDITOR]))
        spot = eye.pixel(aim.contact)

        def is_seen() -> bool:
            now = picture(ben, "3-ben-sees", tmp_path)
            return float(np.abs(around(now, spot) - around(before, spot)).mean()) > 8.0

        until(is_seen, "the other's ball is seen", ben)

        # chooses the part by a click
        ben.get_by_role("tab", name="Parts").click()
        ben.mouse.click(*eye.pixel(aim.seen))
        ben.get_by_text(str(aim.id), exact=True).wait_for()

        # and moves it up and away: what one held against is gone
        ben.get_by_text("Move", exact=True).click()
        ben.get_by_label("Move the chosen part").check()
        ben.wait_for_timeout(1000)
        arrow = facts.up * (GRABBED * MOVING_GIZMO * facts.diagonal)
        drag(ben, eye, aim.middle + arrow, facts.up * (0.2 * facts.diagonal))
        ben.get_by_text("Done", exact=True).wait_for()
        until(lambda: force_on(ada) == 0.0, "the force is zero", ada)
        picture(ben, "4-ben-has-moved", tmp_path)
        picture(ada, "5-ada-is-free", tmp_path)

        # a sweep of that part, down again, is caught by the car
        close_notes(ben)
        ben.get_by_role("tab", name="Sweep").click()
        field(ben, "Way").click()
        ben.get_by_role("option", name=f"-{'xyz'[aim.up]}", exact=True).click()
        field(ben, "Length, m").fill(f"{0.5 * facts.diagonal:.3f}")
        ben.get_by_role("button", name="Run the sweep").click()
        until(lambda: ": hits" in ben.locator("body").inner_text(), "the hit is told", ben)
        ben.wait_for_timeout(1000)
        picture(ben, "6-ben-sweeps", tmp_path)


def type_place(page: Page, place: Floats) -> None:
    """Type the hand's place into its opened folder."""
    for entry, value in zip(hand_fields(page), place, strict=True):
        entry.fill(f"{value:.5f}")


def test_a_person_hides_measures_records_and_replays(
    server: Running, aim: Aim, tmp_path: Path
) -> None:
    token = next(token for token, role in TOKENS.items() if role is Role.EDITOR)
    with chromium() as browser:
        eve = opened(new_page(browser, f"{server.address}?token={token}"))
        eye = Eye(eve, aim.framing, aim.up)

        # a session is recorded while the ball goes into the bonnet
        eve.get_by_role("tab", name="Record").click()
        eve.get_by_role("button", name="Record", exact=True).click()
        eve.get_by_text("Records ").wait_for()
        eve.get_by_role("tab", name="Touch").click()
        eve.get_by_text("Where the hand is").click()
        type_place(eve, aim.contact + aim.facts.up * (3.0 * aim.radius))
        eve.wait_for_timeout(1000)
        type_place(eve, aim.contact)
        until(lambda: (force_on(eve) or 0.0) > 0.5, "a force is read", eve)
        eve.get_by_role("tab", name="Record").click()
        eve.get_by_role("button", name="Stop", exact=True).click()
        eve.get_by_text("Recorded ").wait_for()
        assert [path.suffix for path in tmp_path.glob("*.hdbrec")] == [".hdbrec"]

        # and is played: its force is that of the recording's end
        field(eve, "Recording").click()
        eve.get_by_role("option").nth(1).click()
        eve.get_by_role("button", name="Play", exact=True).click()
        until(lambda: replayed_force(eve) > 0.5, "the recording's force is shown", eve)
        picture(eve, "7-eve-replays", tmp_path)

        # a distance between two clicks
        eve.get_by_role("tab", name="Parts").click()
        eve.get_by_text("Distance", exact=True).first.click()
        eve.get_by_label("Measure between two clicks").check()
        eve.mouse.click(*eye.pixel(aim.seen))
        eve.get_by_text("Click the second place.").wait_for()
        eve.mouse.click(*eye.pixel(aim.other))
        until(lambda: "Along x / y / z" in eve.locator("body").inner_text(), "it is told", eve)
        found = re.search(r"Distance\s+([\d.]+) mm", eve.locator("body").inner_text())
        assert found is not None
        expected = 1000.0 * float(np.linalg.norm(aim.other - aim.seen))
        assert float(found.group(1)) == pytest.approx(expected, abs=2.0)  # a pixel is 0.4 mm
        eve.get_by_label("Measure between two clicks").uncheck()
        picture(eve, "8-eve-measures", tmp_path)

        # what is hidden is not felt
        eve.mouse.click(*eye.pixel(aim.seen))
        eve.get_by_text(str(aim.id), exact=True).wait_for()
        eve.get_by_role("button", name="Hide", exact=True).click()
        eve.get_by_role("tab", name="Touch").click()
        until(lambda: force_on(eve) == 0.0, "nothing is felt", eve)
        picture(eve, "9-eve-hides", tmp_path)


def replayed_force(page: Page) -> float:
    """Force that the tab Record shows, newtons; 0 if it shows none."""
    found = re.search(r"Time\s+[\d.]+ s\s+Force\s+([\d.]+) N", page.locator("body").inner_text())
    return 0.0 if found is None else float(found.group(1))
