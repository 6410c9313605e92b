"""The verb touch."""

from collections import Counter
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hapticdb.cli import render
from hapticdb.cli.emit import STDOUT, TableOutput, open_csv
from hapticdb.cli.options import LawName, StrategyName, UnitName
from hapticdb.cli.selection import FilterOptions
from hapticdb.cli.tool_options import ToolOptions, shell_record, shell_text
from hapticdb.cli.values import refuse
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import record
from hapticdb.tabular.tables import open_table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.batches.batch_results import TouchBatch
    from hapticdb.environment import Environment
    from hapticdb.paper.strategies import Strategy
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.query.touches import Touch
    from hapticdb.store.base import Object

TOUCHED = ("pose", "force", "torque", "hits", "contacts", "deepest", "touched")
"""Keys of `touch --csv`: a row for each pose."""
CONTACTS = ("pose", "point", "place", "depth", "id", "name")
"""Keys of `touch --contacts-csv`: a row for each pair of a contact and a touched object."""


@dataclass(frozen=True)
class _Output(TableOutput):
    contacts_csv: str | None = None
    out: str | None = None
    on: str | None = None

    def __post_init__(self) -> None:
        if self.out is not None:
            refuse("with --out", self, "csv contacts_csv json")
        else:
            refuse("without --out", self, "on")
        if [self.csv, self.contacts_csv, "-" if self.json else ""].count(STDOUT) > 1:
            raise UsageError("--csv -, --contacts-csv -, --json: only one may be standard output")


@dataclass(frozen=True)
class QueryOptions:
    """Options of the queries of single poses."""

    strategy: StrategyName = "auto"
    maxgap: int = 500


def touch(
    url: str,
    *,
    tool: ToolOptions,
    poses: str,
    path_unit: UnitName | None = None,
    query: QueryOptions,
    selection: FilterOptions,
    law: LawName | None = None,
    stiffness: float = 1000.0,
    output: _Output,
) -> None:
    """Touch with a tool along a path: force, torque, objects.

    Example: hapticdb touch car.db --tool spanner.stl --poses path.csv --json
    """
    import hapticdb
    from hapticdb.poses import read_poses
    from hapticdb.query.law import law_named

    if output.out is not None:
        refuse("with --out", query)
    if query.strategy != "maxgap":
        refuse("without --strategy maxgap", query, "maxgap")
    if output.on == "cuda":
        from hapticdb.batches.on_gpu import check_gpu

        check_gpu()  # before kernels are compiled
    path = read_poses(poses, unit=path_unit or "m")
    summary = _Summary()
    with (
        open_csv(output.csv, TOUCHED) as table,
        open_csv(output.contacts_csv, CONTACTS, "--contacts-csv") as contacts,
        hapticdb.open(url, read_only=True) as env,
    ):
        name = law or ("distance" if env.has_distances else "plane")
        chosen, found = law_named(name, stiffness), selection.resolve(env)
        shell = tool.made(env, name, found.excluded).shell
        which: dict[str, Any] = {"where": found.where, "exclude": found.exclude, "law": chosen}
        if output.out is not None:
            pieces = env.touch_pieces(shell, path, on=output.on or "cpu", **which)
            _touch_into(Path(output.out), shell, pieces)
            return
        used = _strategy_of(query.strategy, env, len(path))
        touch_at = partial(env.touch, shell, strategy=used, maxgap=query.maxgap, **which)
        touch_at(path[0])  # compiles kernels and reads statistics, outside of the frames' times
        for index, pose in enumerate(path):
            touched = touch_at(pose)
            summary.add(touched)
            if table or output.json:
                values = {"pose": index, "law": name} | _record(touched)
                output.add(table, values | {"shell": shell_record(shell)})
            if contacts:
                contacts.add(*_contacts(index, touched, shell, pose))
    if output.has_words and output.contacts_csv != STDOUT:
        summary.show(shell, name)


def _touch_into(
    out: Path, shell: "PointShell", pieces: "Generator[TouchBatch, None, None]"
) -> None:
    """Write forces and contacts to a file, batch by batch."""
    first = n_touching = 0
    with open_table(out, "--out") as write, closing(pieces):
        for batch in pieces:
            write(batch.columns(first))
            first += len(batch)
            n_touching += int((batch.n_contacts > 0).sum())
    render.facts([
        ("shell", shell_text(shell)),
        ("poses", f"{first:,}: {n_touching:,} in contact"),
        ("results", str(out)),
    ])  # fmt: skip


def _strategy_of(wanted: "Strategy", env: "Environment", n_poses: int) -> "Strategy":
    """Strategy of the queries: `array` instead of `auto` on a short path without stored costs.

    A calibration takes most of a second, and `touch`, which only reads, cannot store it.
    """
    from hapticdb.paper.cost_model import machine_name

    is_short = n_poses < 500 and not env.store.costs(machine_name())
    return "array" if wanted == "auto" and is_short else wanted


def _record(touched: "Touch") -> dict[str, Any]:
    return record(touched, "force torque touched=objects query") | {
        "hits": len(touched.hits),
        "contacts": len(touched.contacts),
        "deepest": float(touched.contact_depths.max(initial=0.0)),
    }


def _contacts(
    index: int, touched: "Touch", shell: "PointShell", pose: "NDArray[np.float64]"
) -> list[dict[str, Any]]:
    """Rows of contacts, ordered by point and id; places in the world frame."""
    depths = dict(zip(touched.contacts.tolist(), touched.contact_depths.tolist(), strict=True))
    names = {obj.id: obj.name for obj in touched.objects}
    return [
        {"pose": index, "point": point, "depth": depths[point], "id": i, "name": names[i],
         "place": (pose[:3, :3] @ shell.points[point] + pose[:3, 3]).tolist()}
        for point, i in touched.contact_pairs.tolist()
    ]  # fmt: skip


def _mean_of(numbers: "NDArray[np.float64]", noun: str) -> str:
    """Mean in words: ``1 statement``, ``3.2 ranges``."""
    mean = f"{numbers.mean():.3g}"
    return f"{mean} {noun}" if mean == "1" else f"{mean} {noun}s"


@dataclass
class _Summary:
    """Figures of a path, collected frame by frame.

    frames : force, N, torque, N m, hits and contacts; statements, ranges, rows and us of the query.
    """

    frames: list[tuple[float, ...]] = field(default_factory=list)
    strategies: Counter[str] = field(default_factory=Counter)
    frames_of: Counter[int] = field(default_factory=Counter)
    objects: dict[int, "Object"] = field(default_factory=dict)

    def add(self, touched: "Touch") -> None:
        """Add a frame."""
        import numpy as np

        force, torque = (float(np.linalg.norm(one)) for one in (touched.force, touched.torque))
        strategy, *counts = touched.query
        self.frames.append((force, torque, len(touched.hits), len(touched.contacts), *counts))
        self.strategies[strategy] += 1
        self.frames_of.update(obj.id for obj in touched.objects)
        self.objects |= {obj.id: obj for obj in touched.objects}

    def show(self, shell: "PointShell", law: str) -> None:
        """Print peaks, times, query counts and touched objects."""
        import numpy as np

        forces, torques, hits, contacts, statements, ranges, rows, elapsed = np.array(self.frames).T
        peak, twist = int(np.argmax(forces)), int(np.argmax(torques))
        median, p99 = np.percentile(elapsed, [50, 99])
        n_hit, n_contact = np.count_nonzero(hits), np.count_nonzero(contacts)
        counts = (_mean_of(statements, "statement"), _mean_of(ranges, "range"))
        render.facts([
            ("shell", shell_text(shell)),
            ("frames", f"{len(hits):,}: {n_hit:,} hit, {n_contact:,} in contact"),
            ("peak force", f"{forces[peak]:.4g} N at pose {peak}"),
            ("peak torque", f"{torques[twist]:.4g} N m at pose {twist}"),
            ("frame time", f"median {median:.0f} µs, p99 {p99:.0f} µs"),
            ("queries a frame", f"{', '.join(counts)}, reads {_mean_of(rows, 'row')}"),
            ("law", law),
            ("strategy", render.shares(self.strategies)),
            ("objects", f"{len(self.objects)} touched"),
        ])  # fmt: skip
        ranked = sorted(self.frames_of.items(), key=lambda item: (-item[1], item[0]))
        rows = ((i, self.objects[i].name, n) for i, n in ranked[:8])
        render.table(("id>", "touched most", "frames>"), rows)
