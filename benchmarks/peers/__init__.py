"""What a user would take instead of hapticdb: each peer built from the same car, asked the same.

A peer that answers by voxels gets the frame's kernels on both sides: they place the shell and find
its keys, the peer looks the keys up, and they sum the wrench. Only the lookup differs, and what is
felt is the same bit for bit. A peer that answers by surfaces asks another question, which it names.
Each works in one thread. One that cannot be had says what to install, and all others are measured.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Protocol, Self

import numpy as np
import trimesh
from numpy.typing import NDArray

from hapticdb import Environment, PointShell
from hapticdb.ingest.layout import Bricks
from hapticdb.mesh import read_file
from hapticdb.sample import SampleFiles
from hapticdb.store.base import BRICK_BYTES, BRICK_SHIFT, Keys
from hapticdb.store.postgres.private_server import Binaries

Pose = NDArray[np.float64]
SAME = "the same hits and wrench, without the objects"
"""What every peer that holds voxels answers."""
INSTALL = "not measured: pip install --no-deps -r requirements/figures.txt"
FAMILIES: Mapping[str, tuple[str, ...]] = {
    "memory": ("dense bitmap", "NumPy searchsorted", "Python set"),
    "lmdb_bricks": ("LMDB",),
    "duckdb_bricks": ("DuckDB",),
    "octomap_tree": ("OctoMap",),
    "open3d_scene": ("Open3D occupancy", "Open3D signed distance"),
    "coal_meshes": ("coal",),
    "pointcloud_patches": ("pgpointcloud",),
}
"""Modules of this package, and the peers that each holds in `PEERS`."""


class PeerMissingError(Exception):
    """A peer cannot be had here; the message is what a result's notes say of it."""


def all_bricks(env: Environment) -> Bricks:
    """All bricks of an environment in that layout, each once, of whatever objects; in memory."""
    whole = np.array([0], dtype=np.int64), np.array([8**env.grid.bits], dtype=np.int64)
    rows = env.store.scan(*whole)
    starts = np.flatnonzero(np.diff(rows.keys, prepend=-1))
    occupancy = rows.occupancy.reshape(-1, BRICK_BYTES)
    return Bricks(rows.keys[starts], np.bitwise_or.reduceat(occupancy, starts, axis=0))


@dataclass(frozen=True)
class PeerWork:
    """What peers are built from.

    Attributes
    ----------
    env : Environment
        Opened, on the brick layout in Z-order.
    shell : PointShell
        The tool's points.
    mesh_path : Path
        The file that the environment was imported from.
    tool_mesh : tuple
        Vertices (V, 3) in metres, tool frame, and faces (F, 3) of the tool.
    folder : Path
        For what a peer keeps in files.
    binaries : Binaries or None
        PostgreSQL with PostGIS and pgpointcloud.
    """

    env: Environment
    shell: PointShell
    mesh_path: Path
    tool_mesh: tuple[NDArray[np.float64], NDArray[np.int64]]
    folder: Path
    binaries: Binaries | None = None

    @classmethod
    def of_sample(
        cls,
        env: Environment,
        shell: PointShell,
        files: SampleFiles,
        folder: Path,
        binaries: Binaries | None = None,
    ) -> Self:
        """The sample car, and the sample's wrench as the tool."""
        tool = trimesh.load_mesh(files.wrench)
        mesh = np.asarray(tool.vertices, dtype=np.float64), np.asarray(tool.faces, dtype=np.int64)
        return cls(env, shell, files.car, mesh, folder, binaries)

    @cached_property
    def bricks(self) -> Bricks:
        """All bricks, each once, of whatever objects; keys ascending."""
        return all_bricks(self.env)

    @cached_property
    def voxels(self) -> Keys:
        """Keys of all voxels, each once, ascending."""
        keys, occupancy, _ = self.bricks
        bits = np.flatnonzero(np.unpackbits(occupancy, bitorder="little"))
        voxels: Keys = keys[bits >> BRICK_SHIFT] << BRICK_SHIFT | bits & (1 << BRICK_SHIFT) - 1
        return voxels

    @cached_property
    def triangles(self) -> NDArray[np.float64]:
        """Corners (T, 3, 3) of all parts, metres, world frame."""
        return np.concatenate([part.triangles() for part in read_file(self.mesh_path).parts])

    def prepare(self) -> None:
        """Read what peers share, so that no build is charged with it."""
        assert len(self.bricks.keys)
        assert len(self.voxels)
        assert len(self.triangles)


class Peer(Protocol):
    """Another system that answers frames.

    name : as plots show it; question : `SAME`, or what else it answers.
    """

    name: str
    question: str

    def build(self, work: PeerWork) -> None:
        """Take the environment in; raises PeerMissingError where the peer cannot be had."""

    def frame(self, pose: Pose) -> int:
        """Answer one frame at world_from_tool (4, 4); returns what it counts, hits or other."""

    def size(self) -> tuple[str, int]:
        """Where what it built lies, ``memory`` or ``file``, and how many bytes it takes."""

    def close(self) -> None:
        """Give back what `build` took."""


class Missing:
    """A peer whose package does not load."""

    question = ""

    def __init__(self, name: str) -> None:
        self.name = name

    def build(self, _work: PeerWork) -> None:
        raise PeerMissingError(INSTALL)

    def frame(self, _pose: Pose) -> int:
        raise PeerMissingError(INSTALL)

    def size(self) -> tuple[str, int]:
        return "memory", 0

    def close(self) -> None:
        pass


def all_peers() -> list[Peer]:
    """Every peer, not yet built; in the place of one whose package does not load, a `Missing`."""
    peers: list[Peer] = []
    for module, names in FAMILIES.items():
        try:
            kinds = import_module(f"peers.{module}").PEERS
        except (ImportError, OSError):  # the package, or a library of the system below it
            peers += [Missing(name) for name in names]
        else:
            peers += [kind() for kind in kinds]
    return peers
