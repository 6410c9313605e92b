"""Header of a recording: everything that a replay needs, except the database."""

import datetime as dt
import io
import json
import math
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from operator import index
from typing import Any, Self

import numpy as np

from hapticdb.errors import FileError, UsageError
from hapticdb.grid import Grid
from hapticdb.pointshell.shell import MAX_POINTS, PointShell, checked_budget
from hapticdb.query.law import DistanceField, ForceLaw, TangentPlane, law_named
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words
from hapticdb.store.urls import redact

MAGIC = b"HDBREC\r\n"
"""First bytes of each recording."""
FORMAT_VERSION = 4
"""Version of the format; files of later versions are refused. Earlier ones lack some keys."""
PREAMBLE = struct.Struct("<8sIIII")
"""First fields of a header: magic, format version, bytes of JSON, points, CRC-32 of the header."""
MOST_TEXT = 1 << 24
"""Greatest size of a header's JSON text, bytes. Larger: more words of a filter fit."""

Value = str | int | float | bool | None | list[Any] | dict[str, Any]


def _now() -> str:
    return dt.datetime.now(dt.UTC).isoformat(timespec="milliseconds")


@dataclass(frozen=True, eq=False)
class Header:
    """Environment, tool and settings of a recorded session.

    Raises `UsageError` if the rate is no positive number, the parameters cannot be JSON, or the law
    is a user's own, which no file can name.
    """

    environment: str
    """URL of the environment, without a password."""
    grid: Grid
    revision: int
    """Of the environment when the session began."""
    shell: PointShell
    rate: float
    """Frames a second that the session was set to."""
    law: ForceLaw = field(default_factory=TangentPlane)
    exclude: Words = ()
    coupling: Mapping[str, Value] = field(default_factory=dict)
    """Parameters of the virtual coupling by their names."""
    version: str = field(default_factory=lambda: version("hapticdb"))
    started: str = field(default_factory=_now)
    """When the session began: ISO 8601, UTC. The frames' times count from this instant."""
    where: Words = ()
    """With `exclude`, which objects were felt: words as of `hapticdb.store.filtering.Filter`, since
    others may have added objects during the session that the words do not choose."""
    budget_points: int | None = None
    """Most points near something that a frame looked at; None: all."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "budget_points", checked_budget(self.budget_points))
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise UsageError(f"rate {self.rate}: give frames a second, above 0")
        if not isinstance(self.law, (TangentPlane, DistanceField)):
            kind = type(self.law).__name__
            raise UsageError(f"law {kind}: only frames of the laws plane and smooth are recorded")
        try:
            coupling = json.loads(json.dumps(dict(self.coupling), allow_nan=False))
        except (TypeError, ValueError, RecursionError):
            raise UsageError(
                "parameters of the coupling are finite numbers and words, by their names"
            ) from None
        object.__setattr__(self, "coupling", coupling)
        object.__setattr__(self, "environment", redact(str(self.environment)))
        felt = Filter(self.where, self.exclude)
        exclude = felt.fixed_ids.tolist() if felt.is_fixed else felt.exclude
        object.__setattr__(self, "where", felt.where)
        object.__setattr__(self, "exclude", tuple(exclude))
        object.__setattr__(self, "revision", int(self.revision))
        object.__setattr__(self, "rate", float(self.rate))

    def differing(self, other: "Header") -> list[str]:
        """Names of the fields that differ from another header's; time, revision, version aside."""
        fields = "environment grid law rate where exclude coupling budget_points"
        names = [name for name in fields.split() if getattr(self, name) != getattr(other, name)]
        return names if _arrays(self.shell) == _arrays(other.shell) else [*names, "shell"]

    def packed(self) -> bytes:
        """Return the header's bytes; `UsageError` if the JSON is longer than `MOST_TEXT`."""
        shell = self.shell
        text = json.dumps(
            {
                "environment": self.environment,
                "grid": asdict(self.grid),
                "revision": self.revision,
                "shell": {"is_closed": shell.is_closed, "link": shell.link, "seed": shell.seed},
                "law": "plane" if isinstance(self.law, TangentPlane) else "smooth",
                "stiffness": self.law.stiffness,
                "rate": self.rate,
                "where": self.where,
                "exclude": self.exclude,
                "budget_points": self.budget_points,
                "coupling": self.coupling,
                "version": self.version,
                "started": self.started,
            }
        ).encode("ascii")
        if len(text) > MOST_TEXT:
            raise UsageError(
                f"a recording's header of {len(text)} bytes: filter objects by fewer words"
            )
        body = text + _arrays(self.shell)
        counts = PREAMBLE.pack(MAGIC, FORMAT_VERSION, len(text), len(shell), 0)[:-4]
        return counts + struct.pack("<I", zlib.crc32(body, zlib.crc32(counts))) + body

    @classmethod
    def read(cls, file: io.RawIOBase, where: str) -> tuple[Self, int]:
        """Read the header of an open recording; return it and the start of the chunks (bytes).

        Raises `FileError` if the file is no recording, has a newer format, or is cut off or damaged
        in its header.
        """
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        preamble = file.read(PREAMBLE.size) or b""
        if preamble[: len(MAGIC)] != MAGIC[: len(preamble)]:
            raise FileError(f"{where} is no recording of hapticdb")
        if len(preamble) < PREAMBLE.size:
            raise FileError(f"{where}: cut off in its header, nothing was recorded; delete it")
        _, number, n_text, n_points, crc = PREAMBLE.unpack(preamble)
        if number > FORMAT_VERSION:
            raise FileError(f"{where}: format {number}, and this hapticdb reads {FORMAT_VERSION}")
        n_bytes = n_text + 48 * n_points + 24
        if n_text <= MOST_TEXT and n_points <= MAX_POINTS and PREAMBLE.size + n_bytes > size:
            raise FileError(f"{where}: cut off in its header, nothing was recorded; delete it")
        if n_text <= MOST_TEXT and n_points <= MAX_POINTS:
            body = file.read(n_bytes) or b""
            if zlib.crc32(body, zlib.crc32(preamble[:-4])) == crc:
                return cls._parse(body, n_text, n_points, where), PREAMBLE.size + n_bytes
        raise FileError(f"{where}: its header is damaged; nothing of it can be read")

    @classmethod
    def _parse(cls, body: bytes, n_text: int, n_points: int, where: str) -> Self:
        points, normals, center = np.split(
            np.frombuffer(body[n_text:], dtype="<f8").reshape(-1, 3), [n_points, 2 * n_points]
        )
        try:
            told = json.loads(body[:n_text])
            grid = told["grid"]
            made = told["shell"]
            return cls(
                environment=told["environment"],
                grid=Grid(grid["voxel_size"], grid["origin"], index(grid["bits"]), grid["curve"]),
                revision=told["revision"],
                shell=PointShell(
                    points,
                    normals,
                    center[0],
                    bool(made["is_closed"]),
                    str(made["link"]),
                    index(made["seed"]),
                ),
                rate=told["rate"],
                law=law_named(told.get("law", "plane"), told["stiffness"]),
                where=told.get("where", ()),
                exclude=told["exclude"],
                coupling=told["coupling"],
                version=str(told["version"]),
                started=str(told["started"]),
                budget_points=told.get("budget_points"),
            )
        except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
            raise FileError(f"{where}: its header cannot be used: {error}") from error


def _arrays(shell: PointShell) -> bytes:
    """Bytes of points, normals and centre in the file's form."""
    arrays = (shell.points, shell.normals, shell.center)
    return b"".join(array.astype("<f8").tobytes() for array in arrays)
