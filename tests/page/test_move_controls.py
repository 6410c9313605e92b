"""A part on its gizmo: every move that a person ends is written, and nothing else."""

import asyncio
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from children import joined
from hapticdb.errors import HapticDBError
from hapticdb.page.browser import Browser
from hapticdb.page.connection import Visitor
from hapticdb.page.edits import PersonsEdits
from hapticdb.page.panels.move_controls import MoveControls

CLIENT = 7
"""Number of the browser's client."""


class Table:
    """A person who has chosen the only part, ticked the box, and may be connected or not."""

    def __init__(self, env: hapticdb.Environment) -> None:
        self.env, self._own = env, PersonsEdits(env)
        self.asked: list[Any] = []
        self.told: list[str] = []
        self.previews: list[Any] = []
        self.gizmos: list[MagicMock] = []
        self.clients = {CLIENT: None}
        (part,) = env.objects()
        self.id = part.id
        browser = Browser.__new__(Browser)
        browser.visitor, browser.chosen = Visitor("Ada", "editor"), (part.id,)
        browser._is_closed = False
        browser.client = MagicMock(client_id=CLIENT)
        browser.client.scene.add_transform_controls = self._add
        browser.client.add_notification = lambda title, *_, **__: self.told.append(title)
        self.site = MagicMock(objects={part.id: part}, error_text=str)
        self.site.facts.diagonal = 1.0
        self.site.server.get_clients = lambda: self.clients
        self.site.edits.submit = lambda *asked: self.asked.append(asked)
        self.site.view.move = lambda _, place: self.previews.append(place)
        self.site.view.put_back = lambda _: self.previews.append(None)
        browser.site = self.site
        self.controls = MoveControls(browser, MagicMock())  # the box is ticked
        self.controls.follow()

    def _add(self, _: str, **props: Any) -> MagicMock:  # noqa: ANN401
        self.gizmos.append(MagicMock(wxyz=(1.0, 0.0, 0.0, 0.0), **props))
        return self.gizmos[-1]

    def work(self) -> None:
        """Do the first edit that was asked for."""
        _, job, then, failed = self.asked.pop(0)
        try:
            answer = job(self._own)
        except HapticDBError as error:
            failed(error)
        else:
            then(answer)

    @property
    def placement(self) -> NDArray[np.float64]:
        return self.env.object(self.id).transform

    def drag(self, height: float, *phases: str, gizmo: MagicMock | None = None) -> None:
        """Drag the newest gizmo up, metres, with these phases; by default, a whole drag."""
        held = gizmo or self.gizmos[-1]
        for phase in phases or ("start", "update", "end"):
            if phase == "update":
                held.position = up(height)[:3, 3] + held.position
            event = SimpleNamespace(target=held, phase=phase, client_id=CLIENT)
            asyncio.run(held.on_update.call_args.args[0](event))

    def see(self) -> None:
        """Follow what was committed."""
        self.site.objects = {obj.id: obj for obj in self.env.objects()}
        self.controls.renew()


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hapticdb.Environment]:
    folder = tmp_path_factory.mktemp("box")
    trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / "box.stl")
    with hapticdb.create(folder / "e.db", hapticdb.Grid(0.01, (-0.32, -0.32, -0.32), 6)) as made:
        made.add(folder / "box.stl")
        yield made


@pytest.fixture
def table(env: hapticdb.Environment) -> Iterator[Table]:
    (part,) = env.objects()
    yield Table(env)
    env.move(part.id, part.transform)


def up(height: float) -> NDArray[np.float64]:
    way = np.eye(4)
    way[2, 3] = height
    return way


def test_move_controls_write_on_release(table: Table) -> None:
    before = table.placement
    table.drag(0.002, "start", "update")
    assert table.asked == []
    assert np.allclose(table.previews[-1], up(0.002) @ before)
    table.drag(0.0, "end")
    (asked,) = table.asked
    assert asked[0] == CLIENT
    table.work()
    assert np.allclose(table.placement, up(0.002) @ before)
    assert table.told == ["Done"]


def test_move_controls_lost_connection_writes_nothing(table: Table) -> None:
    table.drag(0.002, "start", "update")
    table.clients.clear()
    table.drag(0.0, "end")  # as viser ends it
    assert table.asked == []
    assert table.previews[-1] is None


@pytest.mark.parametrize("order", ["work see drag", "drag work drag"])
def test_move_controls_consecutive_drags(table: Table, order: str) -> None:
    """Also before the first is written, and before this browser has read what is written."""
    before, n_drags = table.placement, 0
    table.drag(0.002)
    for what in order.split():
        if what == "drag":
            table.drag(0.001)
            n_drags += 1
        elif what == "work":
            table.work()
        else:
            table.see()
    while table.asked:
        table.work()
        table.see()
    assert len(table.gizmos) <= 2  # it stays while own moves are not written
    assert np.allclose(table.placement, up(0.002 + 0.001 * n_drags) @ before)
    assert set(table.told) == {"Done"}


def test_move_controls_concurrent_move_conflict(table: Table) -> None:
    table.drag(0.002, "start", "update")
    theirs = table.env.move(table.id, up(-0.003) @ table.placement)
    table.see()
    assert len(table.gizmos) == 1  # it is being dragged
    table.drag(0.0, "end")
    table.work()
    assert table.told == ["Not moved"]
    assert table.previews[-1] is None
    assert np.array_equal(table.placement, theirs.transform)
    assert len(table.gizmos) == 2
    table.drag(0.001)
    table.work()
    assert np.allclose(table.placement, up(0.001) @ theirs.transform)


def test_move_controls_drag_of_replaced_gizmo_dropped(table: Table) -> None:
    table.drag(0.002, "start", "update")
    table.controls.follow()
    assert table.previews[-1] is None
    table.drag(0.001, "update")  # viser finds gizmos by name: the rest of the drag
    table.drag(0.0, "end", gizmo=table.gizmos[0])
    assert table.previews[-1] is None
    assert table.asked == []
    table.env.move(table.id, up(-0.003) @ table.placement)
    table.see()
    assert len(table.gizmos) == 3


def test_move_controls_gizmo_thread_exclusion(table: Table) -> None:
    others: list[threading.Thread] = []
    n_inside, most = 0, 0

    def free() -> None:
        nonlocal n_inside, most
        n_inside += 1
        most = max(most, n_inside)
        if not others:
            others.append(threading.Thread(target=table.controls.follow))
            others[0].start()
            others[0].join(0.05)  # it would be inside by now
        n_inside -= 1

    table.gizmos[-1].remove = free
    table.controls.follow()
    joined(others[0])
    assert most == 1
    assert len(table.gizmos) == 3
