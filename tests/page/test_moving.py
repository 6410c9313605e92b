"""A part on its gizmo: every move that a person ends is written, and nothing else."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from children import joined
from hapticdb.errors import HapticDBError
from hapticdb.page.browser import Browser
from hapticdb.page.connection import Visitor
from hapticdb.page.editing import PersonsEdits
from hapticdb.page.panels.moving import MovingControls
from hapticdb.sample.write import write_sample

CLIENT = 7
"""Number of the browser's client."""


class Widget:
    """A widget, or a gizmo: it knows its callbacks; `freed` is called when it is removed."""

    def __init__(self, freed: Callable[[], object] = lambda: None, **props: Any) -> None:  # noqa: ANN401
        self.value, self.position = False, np.zeros(3)
        self.calls: list[Any] = []
        self._freed = freed
        self.__dict__.update(props)

    def on_update(self, call: Any) -> None:  # noqa: ANN401
        self.calls.append(call)

    on_click = on_update

    def remove(self) -> None:
        self._freed()


class WaitingEdits:
    """Edits that are done when `work` is called, by the same thread."""

    def __init__(self, env: hapticdb.Environment) -> None:
        self._env = env
        self._of: dict[int, PersonsEdits] = {}
        self.asked: list[tuple[int, Any, Any, Any]] = []

    def ask(self, person: int, *work: Any) -> None:  # noqa: ANN401
        self.asked.append((person, *work))

    def work(self) -> None:
        person, job, then, failed = self.asked.pop(0)
        own = self._of.setdefault(person, PersonsEdits(self._env))
        try:
            answer = job(own)
        except HapticDBError as error:
            failed(error)
        else:
            then(answer)


class Table:
    """A person who has chosen the only part, ticked the box, and may be connected or not."""

    def __init__(self, env: hapticdb.Environment) -> None:
        self.env, self.edits = env, WaitingEdits(env)
        self.told: list[str] = []
        self.previews: list[Any] = []
        self.clients = {CLIENT: None}
        self.gizmos: list[Widget] = []
        self.freed: Callable[[], object] = lambda: None
        (part,) = env.objects()
        self.id = part.id
        browser = Browser.__new__(Browser)
        browser.visitor, browser.chosen = Visitor("Ada", "editor"), (part.id,)
        browser._is_closed = False
        scene = SimpleNamespace(add_transform_controls=self._add)
        browser.client = SimpleNamespace(  # type: ignore[assignment]
            client_id=CLIENT,
            scene=scene,
            add_notification=lambda title, *_, **__: self._tell(title),
        )
        self.site = SimpleNamespace(
            edits=self.edits,
            objects={part.id: part},
            facts=SimpleNamespace(diagonal=1.0),
            server=SimpleNamespace(get_clients=lambda: self.clients),
            error_text=str,
            view=SimpleNamespace(
                move=lambda _, place: self.previews.append(place),
                put_back=lambda _: self.previews.append(None),
            ),
        )
        browser.site = self.site  # type: ignore[assignment]
        made = [Widget() for _ in range(3)]
        gui: Any = SimpleNamespace(
            add_folder=lambda *_, **__: nullcontext(),
            add_checkbox=lambda *_, **__: made[0],
            add_button_group=lambda *_, **__: made[1],
            add_button=lambda *_, **__: made[2],
        )
        self.controls = MovingControls(browser, gui)
        made[0].value = True
        self.controls.follow()

    def _tell(self, title: str) -> None:
        self.told.append(title)

    def _add(self, _: str, **props: Any) -> Widget:  # noqa: ANN401
        gizmo = Widget(self._free, wxyz=(1.0, 0.0, 0.0, 0.0), **props)
        self.gizmos.append(gizmo)
        return gizmo

    def _free(self) -> None:
        self.freed()

    @property
    def placement(self) -> NDArray[np.float64]:
        return self.env.object(self.id).transform

    def drag(self, height: float, *phases: str, gizmo: Widget | None = None) -> None:
        """Drag the newest gizmo up, metres, with these phases; by default, a whole drag."""
        held = gizmo or self.gizmos[-1]
        for phase in phases or ("start", "update", "end"):
            if phase == "update":
                held.position = up(height)[:3, 3] + held.position
            event = SimpleNamespace(target=held, phase=phase, client_id=CLIENT)
            asyncio.run(held.calls[0](event))

    def see(self) -> None:
        """Follow what was committed."""
        self.site.objects = {obj.id: obj for obj in self.env.objects()}
        self.controls.renew()


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample")
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=7, extent=1.6))
    hapticdb.import_files(folder / "car.db", [write_sample(folder, 10).wrench], options)
    return folder / "car.db"


@pytest.fixture
def table(sample: Path) -> Iterator[Table]:
    with hapticdb.open(sample) as env:
        (part,) = env.objects()
        yield Table(env)
        env.move(part.id, part.transform)


def up(height: float) -> NDArray[np.float64]:
    way = np.eye(4)
    way[2, 3] = height
    return way


def test_a_move_is_written_when_it_is_let_go_of(table: Table) -> None:
    before = table.placement
    table.drag(0.002, "start", "update")
    assert table.edits.asked == []
    assert np.allclose(table.previews[-1], up(0.002) @ before)
    table.drag(0.0, "end")
    (asked,) = table.edits.asked
    assert asked[0] == CLIENT
    table.edits.work()
    assert np.allclose(table.placement, up(0.002) @ before)
    assert table.told == ["Done"]


def test_a_connection_that_is_lost_in_a_drag_moves_nothing(table: Table) -> None:
    table.drag(0.002, "start", "update")
    table.clients.clear()
    table.drag(0.0, "end")  # as viser ends it
    assert table.edits.asked == []
    assert table.previews[-1] is None


@pytest.mark.parametrize("order", ["work see drag", "drag work drag"])
def test_a_drag_that_follows_another_goes_on_from_it(table: Table, order: str) -> None:
    """Also before the first is written, and before this browser has read what is written."""
    before, n_drags = table.placement, 0
    table.drag(0.002)
    for what in order.split():
        if what == "drag":
            table.drag(0.001)
            n_drags += 1
        elif what == "work":
            table.edits.work()
        else:
            table.see()
    while table.edits.asked:
        table.edits.work()
        table.see()
    assert len(table.gizmos) <= 2  # it stays while own moves are not written
    assert np.allclose(table.placement, up(0.002 + 0.001 * n_drags) @ before)
    assert set(table.told) == {"Done"}


def test_another_persons_move_refuses_the_drag_and_stays(table: Table) -> None:
    table.drag(0.002, "start", "update")
    theirs = table.env.move(table.id, up(-0.003) @ table.placement)
    table.see()
    assert len(table.gizmos) == 1  # it is being dragged
    table.drag(0.0, "end")
    table.edits.work()
    assert table.told == ["Not moved"]
    assert table.previews[-1] is None
    assert np.array_equal(table.placement, theirs.transform)
    assert len(table.gizmos) == 2
    table.drag(0.001)
    table.edits.work()
    assert np.allclose(table.placement, up(0.001) @ theirs.transform)


def test_a_drag_of_a_gizmo_that_was_replaced_is_dropped(table: Table) -> None:
    table.drag(0.002, "start", "update")
    table.controls.follow()
    assert table.previews[-1] is None
    table.drag(0.001, "update")  # viser finds gizmos by name: the rest of the drag
    table.drag(0.0, "end", gizmo=table.gizmos[0])
    assert table.previews[-1] is None
    assert table.edits.asked == []
    table.env.move(table.id, up(-0.003) @ table.placement)
    table.see()
    assert len(table.gizmos) == 3


def test_two_threads_never_change_the_gizmo_at_once(table: Table) -> None:
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

    table.freed = free
    table.controls.follow()
    joined(others[0])
    assert most == 1
    assert len(table.gizmos) == 3
