"""The sample as files: car.glb, spanner.stl, path.csv and rules.toml."""

import lzma
import os
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hapticdb.errors import FileError, UsageError
from hapticdb.tabular.tables import new_file


class SampleFiles(NamedTuple):
    """Paths of the written files."""

    car: Path
    spanner: Path
    path: Path
    rules: Path


RULES = """# Meant findings of the car: one clash is left, a fuel line through a cross member.
rules = [
    "engine/alternator in engine/block: overlap up to 3 mm is meant because its foot is pressed in",
    "* in *: touching, apart is meant because the car's parts stand face to face",
]
"""


def _content(name: str) -> bytes:
    """Content of a file of the sample."""
    packed = files("hapticdb.sample").joinpath(f"{name}.xz").read_bytes()
    return lzma.decompress(packed)


def _write(path: Path, content: bytes) -> Path:
    """Write a file atomically."""
    with new_file(path, "sample", replaces=True) as part:
        part.write_bytes(content)
    return path


def write_sample(folder: str | os.PathLike[str], count: int = 1000) -> SampleFiles:
    """Write car.glb, spanner.stl, path.csv and rules.toml into a folder, made when missing.

    The path comes down from above, then slides the spanner over hood, windscreen, roof, rear window
    and boot. Its deepest point is 1 mm below the surface: a contact at any voxel size of the
    imported car. `count` of its poses are written, evenly spread; UsageError if the path has fewer.

    The spanner is 0.25 m long: its handle lies along x with the ring at +x, the flat sides towards
    -z and +z, the origin halfway along and halfway through.
    """
    header, *poses = _content("path.csv").splitlines(keepends=True)
    if not 1 <= count <= len(poses):
        raise UsageError(f"a path of {count} poses: give 1 to {len(poses):,}")
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot make the folder {target}: {error.strerror}") from error
    chosen = np.linspace(0, len(poses) - 1, count).round().astype(np.int64)
    return SampleFiles(
        _write(target / "car.glb", _content("car.glb")),
        _write(target / "spanner.stl", _content("spanner.stl")),
        _write(target / "path.csv", header + b"".join(poses[index] for index in chosen)),
        _write(target / "rules.toml", RULES.encode()),
    )
