"""Every option that names objects accepts several, by id, name and pattern."""

import json
from pathlib import Path

import pytest

import hapticdb
from command_line import Run, poses, refused, succeeded

TOUCH = ("--tool", "tool.npz", "--poses", "path.csv")


def ids_in(scene: Path) -> list[int]:
    with hapticdb.open(scene, read_only=True) as env:
        return [obj.id for obj in env.objects()]


def test_filter_same_objects_for_each_verb(run: Run, scene: Path) -> None:
    """The same words for touch, sweep and feel; --exclude leaves out some of what is chosen."""

    def hits(*words: str) -> list[int]:
        out = run("touch", scene, *TOUCH, "--json", *words)[1]
        return [json.loads(line)["hits"] for line in out.splitlines()]

    everything = hits()
    assert hits("--where", "box*") == hits("--where", "up=?") == everything
    assert hits("--where", "box1", "--exclude", "box1") == [0, 0, 0]
    each = [hits("--where", f"box{n}") for n in range(3)]
    assert [max(column) for column in zip(*each, strict=True)] == everything
    path = ("--tool", "tool.stl", "--path", "path.csv", "--json")
    for n in range(3):
        found = json.loads(run("sweep", scene, *path, "--where", f"box{n}")[1])
        assert [one["name"] for one in found["hits"]] == ["box1"] * (n == 1)
        assert found["excluded"] == sorted({1, 2, 3} - {n + 1})
    hand = ("--tool", "tool.npz", "--device", "path.csv", "--rate", 200)
    code, out, err = run(
        "feel", scene, *hand, "--json", "--where", "box*", "--exclude", "up=?",
        "--no-baseline", "--seconds", 0.2,
    )  # fmt: skip
    assert (code, json.loads(out)["hit_frames"]) == (0, 0), err
    for verb in (("touch", scene, *TOUCH), ("feel", scene, *hand), ("sweep", scene, *path)):
        refused(run(*verb, "--where", "ball"), "--where: no object 'ball'")


@pytest.mark.parametrize("parts", [("1", "--part", "3"), ("box[02]",)])
def test_part_option_several_parts_one_tool(run: Run, scene: Path, parts: tuple[str, ...]) -> None:
    """Boxes 0 and 2 are one tool; box 1, between them, is in the way of box 0."""
    up = poses(scene.parent / "up.csv", (0.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    aside = poses(scene.parent / "aside.csv", (0.0, 0.0, 0.0), (0.15, 0.0, 0.0))
    code, out, err = run("sweep", scene, "--part", *parts, "--path", up, "--json")
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert (found["parts"], found["excluded"]) == ([1, 3], [1, 3])
    code, out, _ = run("sweep", scene, "--part", *parts, "--path", aside, "--json")
    assert (code, [one["id"] for one in json.loads(out)["hits"]]) == (1, [2])
    # box 2 alone has a free path, so the result above does not come from it alone
    assert run("sweep", scene, "--part", "3", "--path", aside)[0] == 0


def test_move_remove_several_objects(run: Run, scene: Path) -> None:
    out = succeeded(run("move", scene, "box[01]", 3, "--translate", "0,0,0.01", "--json"))
    assert [json.loads(line)["id"] for line in out.splitlines()] == [1, 2, 3]
    placed = ("--matrix", "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1")
    refused(run("move", scene, "box*", *placed), "3 are chosen")
    for wrong in ("cone*", "9", "first"):
        refused(run("remove", scene, "box1", wrong), "no object", wrong)
    assert ids_in(scene) == [1, 2, 3]
    out = succeeded(run("remove", scene, "box1", "2,3", "--json"))
    assert [json.loads(line)["name"] for line in out.splitlines()] == ["box1", "box2"]
    assert ids_in(scene) == [1]


def test_words_number_is_id_then_name(run: Run, tmp_path: Path) -> None:
    corners = "".join(f"v {x} 0 {y}\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    faces = "".join(f"o {name}\nf 1 2 3\n" for name in ("2", "4711", "body", "9"))
    (tmp_path / "numbers.obj").write_text(corners + faces)
    run("import", "n.db", "numbers.obj", "--bits", 4, "--no-distances")
    for word, name, taken in (("9", "9", "a name"), ("2", "4711", "an id"), ("name=2", "2", "")):
        out, err = run("objects", "n.db", "--name", word, "--json")[1:]
        assert json.loads(out)["name"] == name
        assert (f"--name: {word} is taken as {taken}" in err) if taken else not err
    out, err = run("remove", "n.db", "2")[1:]
    assert "removed 2 (4711)" in out
    assert "2 is taken as an id; 'name=2' is a name" in err
    out, err = run("remove", "n.db", "9")[1:]
    assert "removed 4 (9)" in out
    assert "9 is taken as a name: no object has this id" in err
    assert run("remove", "n.db", "name=2", "3")[1:] == ("removed 1 (2)\nremoved 3 (body)\n", "")
    refused(run("remove", "n.db", "5"), "WORDS: no object 5")
