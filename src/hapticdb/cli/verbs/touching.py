"""The verb touch."""

from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.choosing import felt_objects
from hapticdb.cli.csv_files import (
    CONTACTS,
    STDOUT,
    TOUCHED,
    CsvWriter,
    open_csv,
    row_of_pose,
    rows_of_contacts,
)
from hapticdb.cli.felt_files import columns_of, open_felt
from hapticdb.cli.options import (
    ConservativeOption,
    CsvOption,
    ExcludeOption,
    JsonOption,
    LawOption,
    PathUnitOption,
    PointsOption,
    SeedOption,
    StiffnessOption,
    StrategyName,
    ToolOption,
    ToolUnitOption,
    UnitName,
    UrlArgument,
    WhereOption,
)
from hapticdb.cli.tools import shell_record, shell_text, tool_of, warn_of_size
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.batches.result import TouchBatch
    from hapticdb.environment import Environment
    from hapticdb.paper.strategies import Strategy
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.query.law import ForceLaw, LawName
    from hapticdb.query.touches import Touch
    from hapticdb.store.base import Object

MOST_TOUCHED = 8
"""Objects in the table of those that were touched in most frames."""
FEW_POSES = 500
"""Poses of a path below which it does not pay to measure the database's costs. Measuring takes most
of a second, and `touch` opens the environment to read, so that it could not keep the figures."""

StrategyOption = Annotated[StrategyName, typer.Option(help="How the database is asked.")]
MaxgapOption = Annotated[
    int,
    typer.Option(
        metavar="KEYS", help="Widest gap that the strategy maxgap reads across, in voxel keys."
    ),
]
TouchPosesOption = Annotated[
    str,
    typer.Option(
        metavar="FILE",
        help="Poses x,y,z,qw,qx,qy,qz with a header, or with --out a .npy of (M, 4, 4) matrices.",
    ),
]
OutOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        help="Feel all poses as a batch, and write a table to a new file: .parquet or .npz.",
    ),
]
OnOption = Annotated[
    str,
    typer.Option(
        metavar="cpu|cuda|ADDRESS",
        help="With --out, what computes: the processors, a GPU of NVIDIA, or workers of "
        "dask.distributed, by their scheduler, tcp://host:8786.",
    ),
]
ContactsCsvOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE", help="Write every contact as CSV to a new file; - is standard output."
    ),
]


def touch(
    url: UrlArgument,
    *,
    tool: ToolOption,
    poses: TouchPosesOption,
    tool_unit: ToolUnitOption = None,
    path_unit: PathUnitOption = None,
    points: PointsOption = None,
    seed: SeedOption = None,
    strategy: StrategyOption = "auto",
    maxgap: MaxgapOption = 500,
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    law: LawOption = None,
    conservative: ConservativeOption = False,
    stiffness: StiffnessOption = 1000.0,
    csv: CsvOption = None,
    contacts_csv: ContactsCsvOption = None,
    out: OutOption = None,
    on: OnOption = "cpu",
    json: JsonOption = False,
) -> None:
    """Touch an environment with a tool along a path: force, torque and objects of every pose.

    Example: hapticdb touch car.db --tool wrench.stl --poses path.csv --json
    """
    import hapticdb
    from hapticdb.query.law import inset_of

    plane, distance = hapticdb.TangentPlane(stiffness), hapticdb.DistanceField(stiffness)
    path, opened = _path_of(poses, path_unit, out, on), partial(hapticdb.open, url, read_only=True)
    with _output(csv, contacts_csv, out, json=json) as output, opened() as env:
        name: LawName = law or ("distance" if env.has_distances else "plane")
        chosen: ForceLaw = distance if name == "distance" else plane
        felt = felt_objects(env, where, exclude)
        reach = inset_of(env.grid.voxel_size, name)
        held = tool_of(tool, tool_unit, points, seed, inset=0.0 if conservative else reach)
        warn_of_size(env, held, felt.left_out)
        shell = held.shell
        if out is not None:
            pieces = env.touch_pieces(
                shell, path, where=felt.where, exclude=felt.exclude, law=chosen, on=on
            )
            _touch_into(Path(out), shell, pieces)
            return
        touch_at = partial(
            env.touch, shell, strategy=_strategy_of(strategy, env, len(path)), where=felt.where,
            exclude=felt.exclude, maxgap=maxgap, law=chosen,
        )  # fmt: skip
        touch_at(path[0])  # compiles kernels and reads statistics, which belong to no frame's time
        for index, pose in enumerate(path):
            output.add(index, touch_at(pose), shell, pose)
    output.finish(shell)


def _path_of(
    poses: str, unit: "UnitName | None", out: str | None, on: str
) -> "NDArray[np.float64]":
    """Poses of a CSV file, or of a .npy file for a batch; refuses what only a batch takes."""
    from hapticdb.poses import map_poses, read_poses

    if on != "cpu" and out is None:
        raise UsageError(f"--on {on}: give --out, too")
    if on == "cuda":
        from hapticdb.batches.on_gpu import check_gpu

        check_gpu()  # before kernels are compiled
    if not poses.lower().endswith(".npy"):
        return read_poses(poses, unit=unit or "m")
    if out is None or unit not in {None, "m"}:
        raise UsageError(f"--poses {poses}: a .npy file is for --out, and in metres")
    return map_poses(poses)


def _touch_into(
    out: Path, shell: "PointShell", pieces: "Generator[TouchBatch, None, None]"
) -> None:
    """Write what is felt, piece by piece, into a file."""
    import numpy as np

    first = n_touching = 0
    with open_felt(out) as write, closing(pieces):
        for felt in pieces:
            write(columns_of(first, felt))
            first += len(felt)
            n_touching += int(np.count_nonzero(felt.n_contacts))
    render.facts([
        ("shell", shell_text(shell)),
        ("poses", f"{first:,}: {n_touching:,} in contact"),
        ("results", str(out)),
    ])  # fmt: skip


@contextmanager
def _output(
    csv: str | None, contacts_csv: str | None, out: str | None, *, json: bool
) -> "Iterator[_Output]":
    """Open the files that the options name; at most one result goes to standard output."""
    if out is not None and (csv or contacts_csv or json):
        raise UsageError("--out: leave out --csv, --contacts-csv and --json")
    to_stdout = [csv == STDOUT, contacts_csv == STDOUT, json]
    if sum(to_stdout) > 1:
        raise UsageError("--csv -, --contacts-csv - and --json: only one may be standard output")
    with (
        open_csv(csv, "--csv", TOUCHED) as poses,
        open_csv(contacts_csv, "--contacts-csv", CONTACTS) as contacts,
    ):
        yield _Output(poses, contacts, json, None if any(to_stdout) else _Summary())


def _strategy_of(wanted: "Strategy", env: "Environment", n_poses: int) -> "Strategy":
    """`array` in place of `auto` on a short path where no costs are kept, else as wanted."""
    from hapticdb.paper.cost_model import machine_name

    if wanted == "auto" and n_poses < FEW_POSES and not env.store.costs(machine_name()):
        return "array"
    return wanted


@dataclass(frozen=True)
class _Output:
    """Where the results of a path go: CSV files, JSON, or a summary at the end."""

    poses: CsvWriter | None
    contacts: CsvWriter | None
    is_json: bool
    summary: "_Summary | None"

    def add(
        self, index: int, touched: "Touch", shell: "PointShell", pose: "NDArray[np.float64]"
    ) -> None:
        """Write the touch at one pose of the path."""
        if self.poses is not None:
            self.poses.write([row_of_pose(index, touched)])
        if self.contacts is not None:
            self.contacts.write(rows_of_contacts(index, touched, shell, pose))
        if self.is_json:
            render.say_json(_record(index, touched) | {"shell": shell_record(shell)})
        if self.summary is not None:
            self.summary.add(touched)

    def finish(self, shell: "PointShell") -> None:
        """Print the summary, unless standard output has been taken for something else."""
        if self.summary is not None:
            self.summary.show(shell)


def _record(index: int, touched: "Touch") -> dict[str, object]:
    return {
        "pose": index,
        "law": getattr(touched.law, "name", ""),
        "force": touched.force.tolist(),
        "torque": touched.torque.tolist(),
        "hits": len(touched.hits),
        "contacts": len(touched.contacts),
        "objects": [{"id": obj.id, "name": obj.name} for obj in touched.objects],
        "query": touched.query._asdict(),
    }


def _mean_of(numbers: "NDArray[np.float64]", noun: str) -> str:
    """Mean in words: ``1 statement``, ``3.2 ranges``."""
    mean = f"{numbers.mean():.3g}"
    return f"{mean} {noun}" if mean == "1" else f"{mean} {noun}s"


@dataclass
class _Summary:
    """What a path felt like, gathered frame by frame.

    frames : force, N, torque, N m, hits and contacts; statements, ranges, rows and us of the query.
    """

    frames: list[tuple[float, ...]] = field(default_factory=list)
    strategies: Counter[str] = field(default_factory=Counter)
    laws: Counter[str] = field(default_factory=Counter)
    frames_of: Counter[int] = field(default_factory=Counter)
    objects: dict[int, "Object"] = field(default_factory=dict)

    def add(self, touched: "Touch") -> None:
        """Count one frame in."""
        import numpy as np

        force, torque = (float(np.linalg.norm(one)) for one in (touched.force, touched.torque))
        strategy, *asked = touched.query
        self.frames.append((force, torque, len(touched.hits), len(touched.contacts), *asked))
        self.strategies[strategy] += 1
        self.laws[getattr(touched.law, "name", "")] += 1
        for obj in touched.objects:
            self.frames_of[obj.id] += 1
            self.objects[obj.id] = obj

    def show(self, shell: "PointShell") -> None:
        """Print it."""
        import numpy as np

        forces, torques, hits, contacts, statements, ranges, rows, elapsed = np.array(self.frames).T
        peak, twist = int(np.argmax(forces)), int(np.argmax(torques))
        median, p99 = np.percentile(elapsed, [50, 99])
        n_hit, n_contact = np.count_nonzero(hits), np.count_nonzero(contacts)
        render.facts([
            ("shell", shell_text(shell)),
            ("frames", f"{len(hits):,}: {n_hit:,} hit, {n_contact:,} in contact"),
            ("peak force", f"{forces[peak]:.4g} N at pose {peak}"),
            ("peak torque", f"{torques[twist]:.4g} N m at pose {twist}"),
            ("frame time", f"median {median:.0f} µs, p99 {p99:.0f} µs"),
            (
                "a frame asks",
                (
                    f"{_mean_of(statements, 'statement')}, {_mean_of(ranges, 'range')}, "
                    f"reads {_mean_of(rows, 'row')}"
                ),
            ),
            ("law", render.shares(self.laws)),
            ("strategy", render.shares(self.strategies)),
            ("objects", f"{len(self.objects)} touched"),
        ])  # fmt: skip
        if self.objects:
            ranked = sorted(self.frames_of.items(), key=lambda item: (-item[1], item[0]))
            render.table(
                ("id>", "touched most", "frames>"),
                [(str(i), self.objects[i].name, str(n)) for i, n in ranked[:MOST_TOUCHED]],
            )
