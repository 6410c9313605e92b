"""Frames of `touch` over bricks met for the first time and again, on scenes not made by us.

Beside them, in turns: a statement for each point (`points`), one for the frame (`array`), and a
dense bitmap in memory. SQLite and the newest PostgreSQL, bricks with distances, a sphere of 300
points at random poses and along a slide, whose bricks fit into memory together.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import costs
import hapticdb
from hapticdb.store.postgres.address import with_environment
from paper.experiments import Budget, dense
from paper.measure import Cell, in_turns
from paper.subject import LAWS, Subject
from paper.workload import Task, random_poses, slide_poses, sphere_shell
from places import Binaries, serving

SERVER = {"max_wal_size": "4GB", "fsync": "off", "shared_buffers": "1GB"}


def measure(url: str, name: str, budget: Budget) -> list[Cell]:
    """Frames on one environment."""
    cells = []
    with hapticdb.open(url, read_only=True) as env:
        subject, shell = Subject(env, name), sphere_shell(env.grid.voxel_size)
        for task in (
            Task("random", shell, random_poses(env, budget.frames)),
            Task("slide", shell, slide_poses(env, shell, budget.frames)),
        ):
            for law in LAWS:
                cells += _of_law(subject, task, law, 4 * budget.cell_s)
    return cells


def _of_law(subject: Subject, task: Task, law: str, limit_s: float) -> list[Cell]:
    """Frames read by statements, the two visits, and the bitmap."""
    env, about = subject.env, {"environment": subject.name, "law": law}
    bitmap = dense(env, task, **about, engine=env.engine)
    read = [subject.alternative(task, one, law=law) for one in ("points", "array")]
    query = subject.query()
    first = subject.alternative(task, "auto", law=law, query=query, visit="first")
    again = subject.alternative(task, "auto", law=law, visit="again")
    for pose in task.poses:
        again.frame(pose), first.frame(pose)
    memory = query.query._memory  # noqa: SLF001 - no user drops it
    assert memory is not None
    first.before = memory.clear
    return in_turns([*read, first, again, bitmap], task.poses, limit_s=limit_s)


def everywhere(
    folder: Path,
    models: Sequence[costs.Model],
    bits: int,
    binaries: Binaries,
    budget: Budget,
    say: Callable[[str], None],
) -> list[Cell]:
    """Frames on every model, on SQLite and on a PostgreSQL server."""
    cells = []
    with serving(folder / "visits", binaries, SERVER) as server:
        for n, model in enumerate(models):
            on_server = with_environment(server.conninfo(), f"visits{n}")
            for url in (str(folder / f"visits{n}.db"), on_server):
                say(f"visits, {model.name}, {url if url == on_server else 'SQLite'}")
                costs.imported(url, str(model.file), bits, model.extent, distances=1)
                cells += measure(url, model.name, budget)
    return cells
