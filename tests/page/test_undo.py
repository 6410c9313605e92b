"""One person's edits beside another's: each step is one write, nothing of another is lost."""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment
from hapticdb.errors import ConflictError, ObjectNotFoundError, UsageError
from hapticdb.page.editing import PersonsEdits
from hapticdb.store.base import Object
from servers import ENGINES, named, url_on

N_BOXES = 3


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boxes of 10 cm in a row; beside the file they are imported with distances."""
    scene = trimesh.Scene()
    for n in range(N_BOXES):
        placed = np.eye(4)
        placed[0, 3] = 0.3 * n
        box = trimesh.creation.box((0.1, 0.1, 0.1))
        scene.add_geometry(box, node_name=f"box{n}", transform=placed)
    made = tmp_path_factory.mktemp("boxes") / "boxes.glb"
    made.write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=7, extent=4.0))
    hapticdb.import_files(made.with_name("e.db"), [made], options)
    return made


@pytest.fixture(params=ENGINES, ids=named)
def url(request: pytest.FixtureRequest, file: Path, tmp_path: Path) -> Iterator[str]:
    with url_on(request.param, tmp_path) as where:
        hapticdb.copy_environment(file.with_name("e.db"), where)
        yield where


@pytest.fixture
def env(url: str) -> Iterator[Environment]:
    """Where the edits of all people are written, as on a page."""
    with hapticdb.open(url) as env:
        yield env


@pytest.fixture
def one(env: Environment) -> PersonsEdits:
    return PersonsEdits(env)


@pytest.fixture
def other(env: Environment) -> PersonsEdits:
    return PersonsEdits(env)


def up(z: float) -> NDArray[np.float64]:
    way = np.eye(4)
    way[2, 3] = z
    return way


def nothing_to_undo(person: PersonsEdits) -> None:
    with pytest.raises(UsageError, match="there is nothing to undo"):
        person.undo()


State = dict[int, tuple[str, bytes, bytes, str]]


def state_of(env: Environment) -> State:
    """Everything of every object but its revision: name, place, voxels, attributes."""
    return {
        obj.id: (
            obj.name,
            obj.transform.tobytes(),
            env.voxels(obj.id).tobytes(),
            f"{sorted(obj.attributes.items())} {obj.rows_crc} {obj.distances_crc} {obj.bounds}",
        )
        for obj in env.objects()
    }


def test_every_step_is_one_write_and_is_undone_exactly(one: PersonsEdits, env: Environment) -> None:
    states, revisions = [state_of(env)], [env.store.revision()]
    steps: list[Callable[[], object]] = [
        lambda: one.move(env.object(1), up(0.2)),
        lambda: one.move(env.object(1), up(0.1)),
        lambda: one.take_out(env.object(2)),
        lambda: one.move(env.object(3), up(0.1)),
        one.put_back,
    ]
    for step in steps:
        step()
        states.append(state_of(env))
        revisions.append(env.store.revision())
    assert 2 not in states[3]
    assert states[5].keys() == {1, 2, 3}
    assert states[5][2] == states[0][2]
    said = []
    for expected in states[-2::-1]:
        said.append(one.undo())
        assert state_of(env) == expected
        revisions.append(env.store.revision())
    nothing_to_undo(one)
    assert np.diff(revisions).tolist() == [1] * (len(revisions) - 1)
    assert said == [
        "undid: put back 2 (box1)",
        "undid: moved 3 (box2) by 100 mm",
        "undid: took out 2 (box1)",
        "undid: moved 1 (box0) by 100 mm",
        "undid: moved 1 (box0) by 200 mm",
    ]


def test_the_second_of_two_is_told_and_nothing_is_lost(
    one: PersonsEdits, other: PersonsEdits, env: Environment
) -> None:
    seen = env.object(1)
    mine = one.move(seen, up(0.1))
    before = state_of(env)
    for step in (partial(other.move, seen, up(0.3)), partial(other.take_out, seen)):
        with pytest.raises(ConflictError, match="box0: somebody has moved it"):
            step()
        assert state_of(env) == before
    nothing_to_undo(other)
    other.move(env.object(1), up(0.3))
    other.undo()
    assert np.array_equal(env.object(1).transform, mine.transform)


@pytest.mark.parametrize("follows", [False, True])
def test_undo_goes_not_behind_what_another_has_written(
    one: PersonsEdits, other: PersonsEdits, env: Environment, *, follows: bool
) -> None:
    """Steps of other objects can be undone after that; those of this object before it cannot."""
    one.move(env.object(2), up(0.1))
    one.move(env.object(1), up(0.1))
    theirs = other.move(env.object(1), up(-0.2))
    if follows:
        one.move(env.object(1), up(0.3))
        one.undo()
    else:
        with pytest.raises(ConflictError, match=r"cannot undo .moved 1 .*somebody has moved it"):
            one.undo()
    assert np.array_equal(env.object(1).transform, theirs.transform)
    assert one.undo() == "undid: moved 2 (box1) by 100 mm"
    nothing_to_undo(one)
    assert np.array_equal(env.object(1).transform, theirs.transform)


def test_what_another_has_taken_out_is_told(
    one: PersonsEdits, other: PersonsEdits, env: Environment
) -> None:
    seen = one.move(env.object(1), up(0.1))
    other.take_out(env.object(1))
    for step in (partial(one.move, seen, up(0.1)), partial(one.take_out, seen), one.undo):
        with pytest.raises(ConflictError, match="box0: somebody has taken it out"):
            step()
    with pytest.raises(UsageError, match="you have taken no part out"):
        one.put_back()
    other.put_back()
    moved = one.move(env.object(1), up(0.1))
    assert np.array_equal(env.object(1).transform, moved.transform)


def test_what_another_has_imported_again_is_not_put_back(
    one: PersonsEdits, url: str, env: Environment, file: Path
) -> None:
    one.take_out(env.object(3))
    with hapticdb.open(url) as theirs:
        (added,) = theirs.add(file).added
    assert added.id > 3
    with pytest.raises(ConflictError, match="put it back meanwhile"):
        one.undo()
    with pytest.raises(UsageError, match="you have taken no part out"):
        one.put_back()
    nothing_to_undo(one)
    assert [obj.name for obj in env.objects()] == ["box0", "box1", "box2"]


STEPS = st.lists(
    st.tuples(st.integers(0, 1), st.sampled_from(["move", "out", "back", "undo", "look"])),
    max_size=14,
)


@pytest.mark.parametrize("url", [None], indirect=True, ids=["sqlite"])
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(steps=STEPS)
def test_a_refused_step_writes_nothing_and_any_other_writes_once(
    env: Environment, steps: list[tuple[int, str]]
) -> None:
    """Two people at once, on one object, in any order."""
    people = PersonsEdits(env), PersonsEdits(env)
    seen: list[Object] = [env.object(1)] * 2
    for n, (who, what) in enumerate(steps):
        before, state = env.store.revision(), state_of(env)
        actions: dict[str, Callable[[], object]] = {
            "move": partial(people[who].move, seen[who], up(0.01 * (n + 1))),
            "out": partial(people[who].take_out, seen[who]),
            "back": people[who].put_back,
            "undo": people[who].undo,
            "look": partial(env.object, 1),
        }
        try:
            found = actions[what]()
            assert env.store.revision() == before + (what != "look")
            seen[who] = found if isinstance(found, Object) else seen[who]
        except (ConflictError, ObjectNotFoundError, UsageError):
            assert (env.store.revision(), state_of(env)) == (before, state)
    for person in people:
        if len(env.objects()) < N_BOXES:
            with contextlib.suppress(UsageError):
                person.put_back()
    env.move(1, np.eye(4))
    assert {obj.id for obj in env.objects()} == {1, 2, 3}
