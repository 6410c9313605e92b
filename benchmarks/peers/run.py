"""Every peer over the same poses, one after the other: built, warmed up, timed, closed."""

import gc
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.bench.measure import Cell, summary
from peers import Peer, PeerMissingError, PeerWork, Pose, all_peers
from peers.own import Own

WARM_FRAMES = 50
"""Untimed frames of each peer."""


class PeerResults(NamedTuple):
    """A cell for each peer that could be measured, and a note for each of the others."""

    cells: list[Cell]
    notes: list[str]


def measure_peers(
    work: PeerWork, poses: NDArray[np.float64], seconds: float, peers: Sequence[Peer] | None = None
) -> PeerResults:
    """Measure hapticdb and its peers.

    Parameters
    ----------
    work : PeerWork
        What peers are built from.
    poses : (M, 4, 4)
        world_from_tool.
    seconds : float
        Of frames for each peer. A peer that reaches it stops, and its cell is marked `cut_short`.
    peers : sequence of Peer, optional
        All of them unless given.

    Returns
    -------
    PeerResults
        `hits_agree` is the share of frames with as many hits as `Environment.touch` finds, None
        for a peer that answers another question.
    """
    work.prepare()
    wanted = [len(work.env.touch(work.shell, pose).hits) for pose in poses]
    measured = PeerResults([], [])
    for peer in (Own(work), *(all_peers() if peers is None else peers)):
        try:
            measured.cells.append(_measure(peer, work, list(poses), wanted, seconds))
        except PeerMissingError as error:
            measured.notes.append(f"{peer.name}: {error}")
    return measured


def _measure(
    peer: Peer, work: PeerWork, poses: list[Pose], wanted: list[int], seconds: float
) -> Cell:
    start = time.perf_counter()
    peer.build(work)
    build_s = time.perf_counter() - start
    try:
        counts, times_us = _frames(peer, poses, seconds)
        where, size = peer.size()
    finally:
        peer.close()
        gc.collect()
    agree = np.equal(counts, wanted[: len(counts)])
    return {
        "peer": peer.name,
        "question": peer.question,
        "hits_agree": float(agree.mean()) if peer.question.startswith("the same") else None,
        "build_s": None if isinstance(peer, Own) else build_s,
        f"{where}_bytes": size,
        "points": len(work.shell.points),
        "frames": len(counts),
        "cut_short": len(counts) < len(poses),
        "hits": float(np.mean(counts)),
        "us": summary(times_us),
    }


def _frames(peer: Peer, poses: list[Pose], seconds: float) -> tuple[list[int], list[float]]:
    """Counts and microseconds of as many poses as the time allows, one at least."""
    started = time.perf_counter()
    for pose in poses[:: max(1, len(poses) // WARM_FRAMES)]:
        peer.frame(pose)
        if time.perf_counter() - started > seconds / 4:
            break
    counts: list[int] = []
    times_us: list[float] = []
    deadline = time.perf_counter() + seconds
    for pose in poses:
        start = time.perf_counter_ns()
        counts.append(peer.frame(pose))
        times_us.append((time.perf_counter_ns() - start) / 1000)
        if time.perf_counter() > deadline:
            break
    return counts, times_us
