"""One tool at one place feels one force by command, library and page; results say what they are."""

import json
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from command_line import Run, poses
from hapticdb.page.tools import from_files, middle_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.session.coupling import limit_text


def test_tool_same_force_in_verb_library_page(run: Run, scene: Path) -> None:
    path = hapticdb.read_poses(poses(scene.parent / "in.csv", (0.0, 0.0, 0.055)))
    command = json.loads(
        run("touch", scene, "--tool", "tool.stl", "--poses", "in.csv", "--json")[1]
    )
    with hapticdb.open(scene) as env:
        assert env.has_distances
        tool = env.tool("tool.stl")
        library = env.touch(tool, path[0])
        assert (env.touch("tool.stl", path[0]).force == library.force).all()
        for wrong in ((tool, path), (path[0], tool)):
            with pytest.raises(hapticdb.errors.UsageError, match="many as poses="):
                env.touch(*wrong)
        (held,) = from_files(["tool.stl"], env.grid.voxel_size, has_distances=env.has_distances)
        centred = path[0].copy()
        centred[:3, 3] += middle_of(tool)
        page = env.touch(held.shell, centred)
        above = np.eye(4)
        above[2, 3] = 0.072
        before = [env.touch(one, above) for one in (tool, PointShell.from_file("tool.stl"))]
        part, drawn = env.shell(1, inset=0.0), env.shell(1)
    assert np.linalg.norm(library.force) > 1.0
    assert command["force"] == library.force.tolist()
    np.testing.assert_allclose(page.force, library.force, rtol=1e-9, atol=1e-9)
    assert not before[0].force.any()
    assert before[1].force.any()  # with points on the surface, contact begins before it
    assert drawn.inset.max() > part.inset.max() == 0.0


@pytest.mark.parametrize(("newtons", "words"), [(7.0, ", at its limit"), (6.9, "")])
def test_limit_text_at_cap(newtons: float, words: str) -> None:
    assert limit_text(newtons, 7.0) == words


def test_results_repr_and_plot(scene: Path) -> None:
    with hapticdb.open(scene) as env:
        tool = env.tool("tool.stl")
        path = hapticdb.read_poses("path.csv")
        swept = hapticdb.sweep(env, tool, path[:2])
        felt, touch = env.touch(tool, poses=path), env.touch(tool, path[0])
        obj, clashes = env.object(2), hapticdb.find_clashes(env)
    checked, same = hapticdb.check_environment(scene), hapticdb.diff_environments(scene, scene)
    for result in (swept, felt, touch, obj, clashes, checked, same):
        assert len(repr(result).splitlines()) == 1
        assert len(repr(result)) < 200
    assert "<td>box0</td>" in touch._repr_html_()
    assert swept.verdict in swept._repr_html_()
    assert "<td>box, m</td><td>(0.15, -0.05, -0.05) to (0.25, 0.05, 0.05)</td>" in obj._repr_html_()
    assert f"<b>{clashes!r}</b>" in clashes._repr_html_()
    most = float(np.linalg.norm(felt.forces, axis=1).max())
    assert f"at most {most:.4g} N" in repr(felt)
    assert f"<td>{most:.4g}</td>" in felt._repr_html_()
