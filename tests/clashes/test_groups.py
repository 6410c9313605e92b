"""Groups of pairs: copies, one part against many, duplicates; ids that stay."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh

import hapticdb
from assemblies import row_of_boxes
from hapticdb import Environment, accept_clash, find_clashes
from hapticdb.clashes.clash_results import clash_of
from hapticdb.clashes.groups import Group, groups_of
from servers import Place

MM = 1e-3


def grouped(env: Environment) -> list[Group]:
    return groups_of(env.store, find_clashes(env).pairs)


def made(path: Path, boxes: Mapping[str, tuple[float, ...]]) -> Environment:
    """Boxes, by name: their edges and the middle, metres."""
    scene = trimesh.Scene()
    for name, (*edges, x, y, z) in boxes.items():
        placed = trimesh.transformations.translation_matrix((x, y, z))
        mesh = trimesh.creation.box(edges)
        scene.add_geometry(mesh, node_name=name, geom_name=f"{edges}", transform=placed)
    file = path.with_suffix(".glb")
    file.write_bytes(scene.export(file_type="glb"))
    env = hapticdb.create(path, hapticdb.Grid(0.02, (-2.0, -2.0, -2.0), 8), distances=False)
    env.add(file)
    return env


def test_groups_of_copies_of_a_pair_share_a_group(tmp_path: Path) -> None:
    with hapticdb.open(row_of_boxes(tmp_path / "row.db", 4, 0.098)) as env:
        (group,) = grouped(env)
        assert (group.kind, len(group.pairs), group.n_parts) == ("overlapping", 3, 4)
        assert group.title() == "cube0, cube1 and 2 alike"
        turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3))
        for obj in env.objects():
            env.move(obj.id, turn @ obj.transform)
        (again,) = grouped(env)
        assert again.id == group.id
        env.shift([1], (0.5, 0.0, 0.0))
        (fewer,) = grouped(env)
        assert (fewer.id, len(fewer.pairs)) == (group.id, 2)


def test_groups_of_id_stable_at_rounding_ties(tmp_path: Path) -> None:
    inch = 0.0254  # a sixteenth: 1587.5 times the step
    place = (0.09, inch / 16, 3 * inch / 16)
    boxes = {"a": (0.1, 0.1, 0.1, 0.0, 0.0, 0.0), "b": (0.1, 0.05, 0.07, *place)}
    with made(tmp_path / "pair.db", boxes) as env:
        found = {grouped(env)[0].id}
        for angle in (0.3, 1.1, 2.7):
            turn = trimesh.transformations.rotation_matrix(angle, (1.0, 2.0, 3.0))
            for obj in env.objects():
                env.move(obj.id, turn @ obj.transform)
            found.add(grouped(env)[0].id)
    assert len(found) == 1


@pytest.mark.parametrize("scale", [(1.0, 2.0, 0.5), (-1.0, 1.0, 1.0), (-2.0, 1.5, 1.0)])
def test_groups_of_id_stable_under_rotation_of_scaled_pair(
    tmp_path: Path, scale: tuple[float, float, float]
) -> None:
    boxes = {"a": (0.1, 0.1, 0.1, 0.0, 0.0, 0.0), "b": (0.1, 0.05, 0.07, 0.05, 0.01, 0.02)}
    with made(tmp_path / "pair.db", boxes) as env:
        env.move(1, np.diag([*scale, 1.0]))
        (group,) = grouped(env)
        turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 3.0))
        for obj in env.objects():
            env.move(obj.id, turn @ obj.transform)
        (again,) = grouped(env)
        assert again.id == group.id
        env.move(1, turn @ np.diag([*scale[::-1], 1.0]))
        assert group.id not in {one.id for one in grouped(env)}


def test_groups_of_independent_of_import_order(tmp_path: Path) -> None:
    boxes: dict[str, tuple[float, ...]] = {}
    for n in range(3):
        boxes[f"bar{n}"] = (0.02, 0.02, 0.5 + 0.01 * n, 0.15 * n, 0.0, 0.0)
        boxes[f"plate{n}"] = (0.8, 0.5 + 0.01 * n, 0.02, 0.0, 0.0, 0.1 * n)
    with (
        made(tmp_path / "one.db", boxes) as env,
        made(tmp_path / "other.db", dict(reversed(boxes.items()))) as other,
    ):
        one, same = ({(group.id, group.part) for group in grouped(of)} for of in (env, other))
    assert len(one) == 3
    assert one == same


def test_groups_of_new_member_reopens_accepted_group(tmp_path: Path) -> None:
    with hapticdb.open(row_of_boxes(tmp_path / "row.db", 5, 0.098)) as env:
        there = env.object(5).transform
        env.shift([5], (0.5, 0.0, 0.0))
        (group,) = grouped(env)
        accept_clash(env, [one.a for one in group.pairs], [one.b for one in group.pairs], "glued")
        (closed,) = grouped(env)
        assert (closed.id, closed.is_open, closed.status()) == (group.id, False, "glued")
        env.move(5, there)
        (again,) = grouped(env)
        assert (again.id, again.is_open, again.status()) == (group.id, True, "3 of 4 accepted")


def test_groups_of_one_part_against_many(tmp_path: Path) -> None:
    pins = {f"pin{n}": (0.02, 0.02, 0.1 + 0.01 * n, 0.1 * n, 0.0, 0.0) for n in range(3)}
    boxes = {"plate": (1.0, 1.0, 0.01, 0.0, 0.0, 0.0), **pins}
    with made(tmp_path / "plate.db", boxes) as env:
        (group,) = grouped(env)
        assert (group.kind, group.part, group.n_parts) == ("overlapping", "plate", 4)
        assert group.title() == "plate, pin0 and 2 others"
        accept_clash(env, ["plate"], ["pin0"], "pressed")
        assert grouped(env)[0].title() == "plate, pin1 and 2 others"  # the open ones first
    del boxes["pin2"]
    with made(tmp_path / "fewer.db", boxes) as env:
        found = grouped(env)
        assert [(one.part, len(one.pairs)) for one in found] == [(None, 1), (None, 1)]
    boxes["pin2"], boxes["pin3"] = pins["pin2"], (0.03, 0.02, 0.1, 0.3, 0.0, 0.0)
    with made(tmp_path / "more.db", boxes) as env:
        (more,) = grouped(env)
        assert (more.id, len(more.pairs)) == (group.id, 4)


def test_groups_of_duplicates_are_not_measured(place: Place, tmp_path: Path) -> None:
    boxes = {f"copy{n}": (0.1, 0.1, 0.1, 0.2, 0.3, 0.4) for n in range(12)}
    boxes |= {f"other{n}": (0.1, 0.1, 0.1, -0.2, 0.3, 0.4) for n in range(2)}
    with made(tmp_path / "dup.db", boxes) as env:
        url = place()
        hapticdb.copy_environment(tmp_path / "dup.db", url)
        with hapticdb.open(url) as there:
            ids = [one.id for one in grouped(there)]
        found = find_clashes(env)
        assert found.counts()["duplicate"] == 12 * 11 // 2 + 1
        assert len(found.of()) == 12 * 11 // 2 + 1
        groups = groups_of(env.store, found.pairs)
        assert [(one.kind, one.n_parts) for one in groups] == [("duplicate", 12), ("duplicate", 2)]
        assert [one.id for one in groups] == ids
        assert groups[0].title() == "copy0, 12 at one place"
        turned = trimesh.transformations.rotation_matrix(np.pi / 2, (0.0, 0.0, 1.0))
        env.move(1, env.object(1).transform @ turned)  # the same points, but no duplicate
        (row,) = (row for row in env.store.pairs() if (row.a, row.b) == (1, 2))
        known = {obj.id: (obj.name, obj.digest) for obj in env.objects()}
        assert clash_of(row, "same", known).kind == "duplicate"
        find_clashes(env)
        (row,) = (row for row in env.store.pairs() if (row.a, row.b) == (1, 2))
        assert row.kind != "duplicate"


def test_groups_of_duplicates_tolerance_is_a_micrometre(tmp_path: Path) -> None:
    boxes = {f"copy{n}": (0.1, 0.1, 0.1, 0.2, 0.3, 0.4) for n in range(5)}
    with made(tmp_path / "dup.db", boxes) as env:
        for n in range(1, 5):
            env.shift([n], (n * 1e-7, 0.0, 0.0))
        (group,) = grouped(env)
        assert (group.kind, group.n_parts, len(group.pairs)) == ("duplicate", 5, 10)
        env.shift([5], (0.0, 2e-6, 0.0))
        turn = trimesh.transformations.rotation_matrix(1e-4, (0.0, 0.0, 1.0), (0.2, 0.3, 0.4))
        env.move(4, turn @ env.object(4).transform)  # corners move by 7 um
        (group,) = (one for one in grouped(env) if one.kind == "duplicate")
        assert {i for one in group.pairs for i in one[:2]} == {1, 2, 3}
