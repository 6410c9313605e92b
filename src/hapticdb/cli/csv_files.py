"""Results as CSV: into a file, whole or not at all, or to standard output.

Numbers are written so that they are read back bit for bit. A name that a spreadsheet would take for
a formula gets an apostrophe in front, which is how spreadsheets themselves mark text.
"""

import csv
import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from hapticdb.cli import render
from hapticdb.errors import FileError, HapticDBError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.exact.swept import PathPlace, Swept
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.query.touches import Touch
    from hapticdb.recording.frame import Frames
    from hapticdb.store.base import Object

STDOUT = "-"
FORMULAS = ("=", "+", "-", "@")
"""What a cell begins with that a spreadsheet computes instead of showing it."""
AXES = ("x", "y", "z")
WRENCH = tuple(
    f"{of}_{axis}_{unit}" for of, unit in (("force", "N"), ("torque", "Nm")) for axis in AXES
)
TOUCHED = ("pose", *WRENCH, "hits", "contacts", "deepest_m", "object_ids", "object_names")
"""Columns of `touch --csv`: a row for each pose."""
CONTACTS = ("pose", "point", "x_m", "y_m", "z_m", "depth_m", "object_id", "object_name")
"""Columns of `touch --contacts-csv`: a row for each contact with each object that it touches."""
SWEPT = (
    "object_id", "object_name", "what", "fraction", "segment", "tool_x_m", "tool_y_m", "tool_z_m",
    "object_x_m", "object_y_m", "object_z_m", "until_fraction", "start_m", "start_at_least_m",
    "reach_m", "by", "depth_at_least_m", "gap_m", "verdict",
)  # fmt: skip
"""Columns of `sweep --csv`: a row for each object that is hit, enclosed or touched at the start,
and one for the nearest object; `what` says which. A cell that does not belong to it is empty."""
_PLACE = (*(f"{axis}_m" for axis in AXES), "qw", "qx", "qy", "qz")
_SPEED = (*(f"v{axis}_m_per_s" for axis in AXES), *(f"w{axis}_rad_per_s" for axis in AXES))
FRAME_COLUMNS: dict[str, tuple[str, ...]] = {
    "time": ("time_s",),
    "dt": ("dt_s",),
    "lateness": ("lateness_s",),
    "elapsed": ("elapsed_s",),
    "hand": tuple(f"hand_{name}" for name in _PLACE),
    "hand_velocity": tuple(f"hand_{name}" for name in _SPEED),
    "tool": tuple(f"tool_{name}" for name in _PLACE),
    "applied": tuple(f"applied_{name}" for name in WRENCH),
    "spring": (
        "spring_N_per_m",
        "turn_spring_Nm_per_rad",
        "cap_N",
        "turn_cap_Nm",
        "damping_Ns_per_m",
        "scale",
        "radius_m",
        "hold_s",
        "fade_s",
    ),
    "hits": ("hits",),
    "contacts": ("contacts",),
    "unknown": ("unknown",),
    "deepest": ("deepest_m",),
    "revision": ("revision",),
    "buttons": ("buttons",),
    "state": ("state",),
}
"""Columns of `replay --csv`, by the fields of a recorded frame: a row for each frame."""


class CsvWriter:
    """Rows that are written as CSV below a header, to a stream that translates no ends of lines."""

    def __init__(self, stream: TextIO, columns: Sequence[str]) -> None:
        self._writer = csv.writer(stream, lineterminator="\n")
        self._columns: Sequence[str] | None = columns

    def write(self, rows: Iterable[Sequence[object]]) -> None:
        """Add rows; a float as the shortest text that is read back as the same float64."""
        self.begin()
        self._writer.writerows(rows)

    def begin(self) -> None:
        """Write the header, unless it is there: not before there is something to say."""
        if self._columns is not None:
            self._writer.writerow(self._columns)
            self._columns = None


@contextmanager
def open_csv(target: str | None, option: str, columns: Sequence[str]) -> Iterator[CsvWriter | None]:
    """Open a new CSV file for writing; None where none is given. After an error no file is left."""
    if target is None:
        yield None
    elif target == STDOUT:
        made = CsvWriter(sys.stdout, columns)
        yield made
        made.begin()
    else:
        with (
            new_file(Path(target), option) as part,
            part.open("w", encoding="utf-8", newline="") as stream,
        ):
            made = CsvWriter(stream, columns)
            yield made
            made.begin()


@contextmanager
def new_file(target: Path, option: str) -> Iterator[Path]:
    """Path to write to, which becomes the target at the end. After an error no file is left."""
    if not target.name or os.path.lexists(target):
        raise UsageError(f"{option} '{target}': give the name of a file that is not there yet")
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        part.touch(exist_ok=False)  # before the work: a folder may be missing
        yield part
        part.replace(target)
    except (BrokenPipeError, HapticDBError):  # of standard output, or of no file
        raise
    except OSError as error:
        if error.filename not in {None, str(part)}:
            raise
        raise FileError(f"{option}: cannot write {target}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


@contextmanager
def new_files(**named: str | None) -> Iterator[dict[str, Path]]:
    """Paths to write to, as `new_file` has them, of the files that are given, by option."""
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(new_file(Path(file), f"--{name}"))
            for name, file in named.items()
            if file is not None
        }


def text_cell(text: str) -> str:
    """A name as a cell: printable, and no formula."""
    shown = render.printable(text).replace("\n", "\\n")
    return f"'{shown}" if shown.startswith(FORMULAS) else shown


def row_of_pose(index: int, touched: "Touch") -> list[object]:
    """Row of `TOUCHED`; objects ordered by id, their ids with a space between."""
    objects = touched.objects
    return [
        index,
        *touched.force.tolist(),
        *touched.torque.tolist(),
        len(touched.hits),
        len(touched.contacts),
        float(touched.contact_depths.max(initial=0.0)),
        " ".join(str(obj.id) for obj in objects),
        text_cell("; ".join(obj.name for obj in objects)),
    ]


def rows_of_contacts(
    index: int, touched: "Touch", shell: "PointShell", pose: "NDArray[np.float64]"
) -> Iterator[list[object]]:
    """Rows of `CONTACTS`, ordered by point and id; points at their places in the world."""
    depths = dict(zip(touched.contacts.tolist(), touched.contact_depths.tolist(), strict=True))
    names = {obj.id: text_cell(obj.name) for obj in touched.objects}
    for point, i in touched.contact_pairs.tolist():
        place = pose[:3, :3] @ shell.points[point] + pose[:3, 3]
        yield [index, point, *place.tolist(), depths[point], i, names[i]]


def rows_of_sweep(found: "Swept") -> Iterator[list[object]]:
    """Rows of `SWEPT`: what is hit, along the path; enclosed; touched at the start; the nearest."""

    def row(
        what: str,
        obj: "Object",
        place: "PathPlace | None" = None,
        contact: Sequence[float | str] = ("",) * 5,
        gap: float | str = "",
    ) -> list[object]:
        where: list[object] = [""] * 8
        if place is not None:
            on_both = [*place.on_tool.tolist(), *place.on_object.tolist()]
            where = [place.fraction, place.segment, *on_both]
        depth = place.at_least if what == "hit" and place is not None else ""
        return [obj.id, text_cell(obj.name), what, *where, *contact, depth, gap, found.verdict]

    for place in found.hits:
        yield row("hit", place.object, place)
    for obj in found.enclosed:
        yield row("enclosed", obj)
    for one in found.touching:
        start = one.start if math.isfinite(one.start) else ""
        contact = one.until, start, one.start_at_least, one.reach, one.by
        yield row("touched", one.object, contact=contact)
    if found.gap.place is not None and found.is_free:
        yield row("nearest", found.gap.place.object, found.gap.place, gap=found.gap.at_least)


def rows_of_frames(frames: "Frames") -> Iterator[list[object]]:
    """Rows of recorded frames; those in single precision as that is read back."""
    columns: list[list[object]] = []
    for name, headings in FRAME_COLUMNS.items():
        values = frames[name].reshape(len(frames), len(headings)).T
        is_single = values.dtype.itemsize == 4 and values.dtype.kind == "f"
        columns += [list(map(str, column)) if is_single else column.tolist() for column in values]
    yield from map(list, zip(*columns, strict=True))
