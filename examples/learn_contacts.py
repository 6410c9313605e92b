"""A data set to learn contacts from: parts of an assembly, at many poses among the others.

    python examples/learn_contacts.py car.db learned.npz body/hood --poses 1000000 --on cuda

The parts stand at their place, shifted and turned at random: by a hundredth of a voxel up to half
of their size. The file has a row for each pose:

displacement (B, 4, 4)  from the parts' place, world frame, metres
force, torque (B, 3)    N, and N m about the parts' centre: zero where nothing is felt
hits, contacts (B,)     points in a voxel, and points that are felt
clearance (B,)          metres from the nearest voxel of another part; 0 where a point is in one
ids, offsets            objects touched: those of pose n are ids[offsets[n]:offsets[n + 1]]

and what it takes to make it again: seed, revision, words, points. Equal arguments and an equal
revision give an equal file, on one kind of device: a GPU adds up in another order than processors.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hapticdb

PIECE = 1 << 17
"""Poses that are felt at once. A larger value takes more memory."""
STIFFNESS = 1000.0
"""Of a contact, N/m: forces are proportional to it."""

Floats = NDArray[np.float64]


def displacements(
    rng: np.random.Generator, count: int, shell: hapticdb.PointShell, size: float
) -> Floats:
    """Random rigid displacements (count, 4, 4) about a shell's centre; size: of a voxel, metres."""
    reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
    least, most = 0.01 * size, max(reach, size)
    way = np.exp(rng.uniform(np.log(least), np.log(most), (count, 1)))
    angle = np.exp(rng.uniform(np.log(least), np.log(most), (count, 1))) / max(reach, size)
    shift, axis = (rng.normal(size=(count, 3)) for _ in range(2))
    shift *= way / np.linalg.norm(shift, axis=1, keepdims=True)
    axis *= np.minimum(angle, np.pi) / np.linalg.norm(axis, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations(axis)
    poses[:, :3, 3] = shell.center + shift - poses[:, :3, :3] @ shell.center
    return poses


def rotations(turns: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3), radians (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    x, y, z = (turns / angle[:, 0]).T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross))


def learned(given: argparse.Namespace) -> dict[str, NDArray[np.generic]]:
    """All columns of the data set."""
    rng = np.random.default_rng(given.seed)
    pieces: list[dict[str, NDArray[np.generic]]] = []
    with hapticdb.open(given.url, read_only=True) as env:
        law = (
            hapticdb.DistanceField(STIFFNESS)
            if env.has_distances
            else hapticdb.TangentPlane(STIFFNESS)
        )
        shell = env.shell(*given.words, points=given.points, seed=given.seed)
        poses = displacements(rng, given.poses, shell, env.grid.voxel_size)
        with env.batch_tool(shell, exclude=given.words, law=law, device=given.on) as batch_tool:
            for first in range(0, len(poses), PIECE):
                part = poses[first : first + PIECE]
                batch = batch_tool.touch(part, objects=True)
                pieces.append(
                    {
                        "force": batch.forces,
                        "torque": batch.torques,
                        "hits": batch.hits,
                        "contacts": batch.n_contacts,
                        "clearance": batch_tool.clearance(part).distances,
                        "ids": batch.ids,
                        "counts": np.diff(batch.offsets),
                        "revision": np.array([batch.revision]),
                    }
                )
    found = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    found["offsets"] = np.concatenate([[0], np.cumsum(found.pop("counts"))])
    about = {"seed": given.seed, "points": given.points, "words": given.words}
    return found | {"displacement": poses} | {name: np.array(one) for name, one in about.items()}


def main(words: list[str] | None = None) -> None:
    """Make the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("url", help="the environment")
    parser.add_argument("out", type=Path, help="a new .npz file")
    parser.add_argument("words", nargs="+", help="the parts that move, by id or name")
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--points", type=int, default=300, help="of the shell of the parts")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--on", choices=("cpu", "cuda"), default="cpu")
    given = parser.parse_args(words)
    found = learned(given)
    with given.out.open("xb") as file:
        np.savez_compressed(file, **found)  # type: ignore[arg-type]
    n_touching = np.count_nonzero(found["contacts"])
    print(f"{given.out}: {given.poses:,} poses, {n_touching:,} in contact, seed {given.seed}")


if __name__ == "__main__":
    main()
