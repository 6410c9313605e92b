"""Frames of `touch` over bricks met for the first time and again, on models not made by us.

Beside them, in turns: a frame that reads its bricks (`array`), a statement for each (`points`), and
a dense bitmap in memory. SQLite, bricks with distances, a sphere of 300 points at 300 random poses,
whose bricks fit into memory together.
"""

import os
import tempfile
from pathlib import Path

import costs
import hapticdb
import page_tables
import records
from paper.experiments import Budget, in_memory
from paper.measure import Cell, in_turns
from paper.subject import LAWS, Subject
from paper.workload import Task, random_poses, sphere_shell


def measure(url: Path, name: str, budget: Budget) -> list[Cell]:
    """Frames on one environment."""
    with hapticdb.open(url, read_only=True) as env:
        subject, shell = Subject(env, name), sphere_shell(env.grid.voxel_size)
        task = Task("random", shell, random_poses(env, budget.frames))
        cells = [one | {"environment": name} for one in in_memory(env, [task], budget)]
        for law in LAWS:
            read = [subject.alternative(task, one, law=law) for one in ("points", "array")]
            query = subject.query()
            first = subject.alternative(task, "auto", law=law, query=query, visit="first")
            again = subject.alternative(task, "auto", law=law, visit="again")
            for pose in task.poses:
                again.frame(pose), first.frame(pose)
            memory = query.query._memory  # noqa: SLF001 - no user drops it
            assert memory is not None
            first.before = memory.clear
            cells += in_turns([*read, first, again], task.poses, limit_s=4 * budget.cell_s)
    return cells


if __name__ == "__main__":
    cells = []
    with tempfile.TemporaryDirectory() as folder:
        for name, file, extent in costs.models(Path(), real=True)[:-1]:  # without the sample
            costs.imported(url := f"{folder}/{name}.db", str(file), 11, extent, distances=1)
            cells += measure(Path(url), name, Budget(frames=300))
    loads = ", ".join(f"{load:.1f}" for load in os.getloadavg())
    inputs = {"first visit": "bricks in memory dropped, not pages", "load": f"{loads} at the end"}
    records.write(records.ROOT / "results", {"visits": records.result("visits", cells, inputs)})
    page_tables.refill("docs/evaluation.md", records.ROOT / "results")
