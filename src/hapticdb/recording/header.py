"""Header of a recording: all inputs of a replay, except the database."""

import datetime as dt
import io
import json
import math
import os
import re
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from operator import index
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from hapticdb.errors import FileError, UsageError
from hapticdb.grid import Grid
from hapticdb.kernels._machine_code import build
from hapticdb.kernels.records.hand import FRAME
from hapticdb.pointshell.shell import MAX_POINTS, PointShell
from hapticdb.query.law import LAWS, ForceLaw, TangentPlane, law_named
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words
from hapticdb.store.urls import redact

FORMAT_VERSION = 1
"""Version of the format; files of other versions are refused."""
MAGIC = b"hapticdb recording "
"""First bytes of a recording."""
FIRST_LINE = re.compile(MAGIC + rb"(\d{1,9}) (\d{12}) ([0-9a-f]{8})\n")
"""First line of a recording: format, offset of the rows in bytes, CRC-32 of the header's rest."""
LINE_BYTES = 43
"""Bytes of the first line, while the format has one digit."""
OLDER = b"HDBREC\r\n"
"""First bytes of recordings from before the first release."""
MOST_BYTES = 1 << 32
"""Greatest size of a header, bytes. Larger: tools with more points fit."""
ROWS_AT = 64
"""Alignment of the first row, bytes: a cache line."""

TEXTS = ("environment", "version", "started", "frames_on", "build")
VALUES = ("revision", "rate", "where", "exclude", "coupling")
"""Fields of a header that are in the file as they are."""

Value = str | int | float | bool | None | list[Any] | dict[str, Any]


class Start(NamedTuple):
    """State of a session before its first recorded frame: memory of the loop (`kernels.records`).

    servo, follower : a record of SERVO and of FOLLOWER; kept, near, bends : records of POINT, NEAR
    and BENDS, empty directly after the tool was placed.
    """

    servo: bytes = b""
    follower: bytes = b""
    kept: bytes = b""
    near: bytes = b""
    bends: bytes = b""


def _now() -> str:
    return dt.datetime.now(dt.UTC).isoformat(timespec="milliseconds")


@dataclass(frozen=True, eq=False)
class Header:
    """Environment, tool and settings of a recorded session.

    Raises `UsageError` if the rate is no positive number, the parameters cannot be JSON, or the law
    is a user's own, without a name in the format.
    """

    environment: str
    """URL of the environment, without a password."""
    grid: Grid
    revision: int
    """Revision of the environment at the session's start."""
    shell: PointShell
    rate: float
    """Frames a second, as set for the session."""
    law: ForceLaw = field(default_factory=TangentPlane)
    exclude: Words = ()
    coupling: Mapping[str, Value] = field(default_factory=dict)
    """Parameters of the rendering by their names, at the session's start."""
    version: str = field(default_factory=lambda: version("hapticdb"))
    started: str = field(default_factory=_now)
    """Start of the recording: ISO 8601, UTC."""
    where: Words = ()
    """With `exclude`, the filter of contacts: words of `hapticdb.store.filtering.Filter`, which
    also apply to objects added during the session."""
    rendering: Literal["coupled", "direct"] = "direct"
    frames_on: str = "cpu"
    """Processor of the frames: "cpu" or "cuda"."""
    build: str = field(default_factory=build)
    """Digest of the kernels' sources, of the compiler and of the processor."""
    start: Start = field(default_factory=Start)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise UsageError(f"rate {self.rate}: give frames a second, above 0")
        if type(self.law) not in map(type, LAWS.values()):
            kind, known = type(self.law).__name__, " and ".join(LAWS)
            raise UsageError(f"law {kind}: only frames of the laws {known} are recorded")
        try:
            coupling = json.loads(json.dumps(dict(self.coupling), allow_nan=False))
        except (TypeError, ValueError, RecursionError):
            raise UsageError(
                "parameters of the coupling are finite numbers and words, by their names"
            ) from None
        object.__setattr__(self, "coupling", coupling)
        object.__setattr__(self, "environment", redact(str(self.environment)))
        selection = Filter(self.where, self.exclude)
        exclude = selection.fixed_ids.tolist() if selection.is_fixed else selection.exclude
        object.__setattr__(self, "where", selection.where)
        object.__setattr__(self, "exclude", tuple(exclude))
        object.__setattr__(self, "revision", int(self.revision))
        object.__setattr__(self, "rate", float(self.rate))

    def packed(self) -> bytes:
        """Bytes of the header."""
        shell = self.shell
        text = json.dumps(
            {name: getattr(self, name) for name in (*TEXTS, *VALUES)}
            | {
                "grid": asdict(self.grid),
                "shell": {
                    "points": len(shell), "is_closed": shell.is_closed, "link": shell.link,
                    "seed": shell.seed,
                },
                "law": self.law.name,  # type: ignore[attr-defined]
                "stiffness": self.law.stiffness,
                "rendering": self.rendering,
                "start": [len(part) for part in self.start],
                "row": FRAME.descr,
            }
        ).encode("ascii")  # fmt: skip
        arrays = [array.astype("<f8").tobytes() for array in (shell.points, shell.normals)]
        blobs = b"".join([*arrays, shell.center.astype("<f8").tobytes(), *self.start])
        spaces = -(LINE_BYTES + len(text) + 1 + len(blobs)) % ROWS_AT
        body = text + b" " * spaces + b"\n" + blobs
        end = LINE_BYTES + len(body)
        return MAGIC + b"%d %012d %08x\n" % (FORMAT_VERSION, end, zlib.crc32(body)) + body

    @classmethod
    def read(cls, file: io.RawIOBase, where: str) -> tuple[Self, int]:
        """Read the header of an open recording; returns it and the offset of the rows, bytes.

        Raises `FileError` if the file is no recording, has another format, or is cut off or damaged
        in its header.
        """
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        line = file.read(LINE_BYTES) or b""
        if line.startswith(OLDER):
            raise FileError(f"{where} was made before 0.1: record it again")
        found = FIRST_LINE.fullmatch(line)
        if found is None and line and not MAGIC.startswith(line[: len(MAGIC)]):
            raise FileError(f"{where} is no recording of hapticdb")
        if len(line) == LINE_BYTES and found is None:
            raise FileError(f"{where}: its header is damaged; nothing of it can be read")
        number, rows_at, crc = (1, size + 1, b"") if found is None else found.groups()
        if int(number) != FORMAT_VERSION:
            raise FileError(f"{where}: format {int(number)}, this hapticdb reads {FORMAT_VERSION}")
        rows_at = int(rows_at)
        if rows_at > size:
            raise FileError(f"{where}: cut off in its header, nothing was recorded; delete it")
        body = file.read(rows_at - LINE_BYTES) if rows_at <= MOST_BYTES else None
        if body is None or b"%08x" % zlib.crc32(body) != crc:
            raise FileError(f"{where}: its header is damaged; nothing of it can be read")
        return cls._parse(body, where), rows_at

    @classmethod
    def _parse(cls, body: bytes, where: str) -> Self:
        text, _, blobs = body.partition(b"\n")
        try:
            given = json.loads(text)
            grid, made = given["grid"], given["shell"]
            n_points = index(made["points"])
            if not 0 < n_points <= MAX_POINTS:
                raise ValueError(f"{n_points} points")  # noqa: TRY301 - as below
            plain: dict[str, Any] = {name: str(given[name]) for name in TEXTS}
            plain |= {name: given[name] for name in VALUES}
            at = 48 * n_points + 24
            numbers = np.frombuffer(blobs[:at], dtype="<f8").reshape(-1, 3)
            points, normals, center = np.split(numbers, [n_points, 2 * n_points])
            start = []
            for length in map(index, given["start"]):
                start.append(blobs[at : at + length])
                at += length
            return cls(
                **plain,
                grid=Grid(grid["voxel_size"], grid["origin"], index(grid["bits"]), grid["curve"]),
                shell=PointShell(
                    points,
                    normals,
                    center[0],
                    bool(made["is_closed"]),
                    str(made["link"]),
                    index(made["seed"]),
                ),
                law=law_named(given["law"], float(given["stiffness"])),
                rendering="coupled" if given["rendering"] == "coupled" else "direct",
                start=Start(*start),
            )
        except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
            raise FileError(f"{where}: its header cannot be used: {error}") from error
