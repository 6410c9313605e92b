"""What a worker tells others of a session: its contacts, what it touches, its figures."""

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.device_spring import contact_stiffness
from hapticdb.kernels.hand.near_points import (
    ALONG,
    FELT_POINTS,
    FLOOR,
    MET_ROWS,
    NEAR,
    NEAR_POINTS,
    NEAR_ROWS,
    ONSETS,
    U,
)
from hapticdb.kernels.records import MOST_ASKED, MOST_SHOWN, TIME_BIN, TIME_BINS
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import moved, transform_of

TOUCHING, FELT, HOSTED_ROWS = MET_ROWS, MET_ROWS + 1, MET_ROWS + 2
"""Rows of a hosted session's `met`, after those of the coupling: the indices of the points that
touch; those of the frame of a recording."""


@leaf
def list_touching(follower, field, met, n_hits, is_loose):
    """Indices of the points that touch, into met[TOUCHING] -> their number.

    Where the tool lies in something these are the points that are in it.
    """
    if not is_loose:
        for n in range(n_hits):
            met[TOUCHING, n] = met[FELT_POINTS, n]
        return n_hits
    rows, near = NEAR + follower.side * NEAR_ROWS, NEAR_POINTS + follower.side
    n_found = 0
    for m in range(follower.n_near):
        if field[rows + U, m] < FLOOR:
            met[TOUCHING, n_found] = met[near, m]
            n_found += 1
    return n_found


@leaf
def _show_contact(seat, at, transform, x, y, z, fx, fy, fz):
    """Write a contact at point (x, y, z) of the tool, with its force, world frame."""
    row = seat.contacts[at]
    row[0], row[1], row[2] = moved(transform, x, y, z)
    row[3], row[4], row[5] = fx, fy, fz


@leaf
def show_contacts(seat, shell, pose, place, spring, follower, field, met):
    """List the contacts on the board."""
    rows, near = NEAR + follower.side * NEAR_ROWS, NEAR_POINTS + follower.side
    points, transform = shell.points, transform_of(pose)
    stiffness = contact_stiffness(spring, place.size)
    n_contacts = 0
    if not follower.is_loose:
        for m in range(follower.n_near):
            n_contacts += field[ONSETS, met[near, m]] > field[rows + U, m]
    every = max((n_contacts + MOST_SHOWN - 1) // MOST_SHOWN, 1)
    seat.contacts_sequence += 1
    fence()
    n_met = n_shown = 0
    if n_contacts > 0:
        for m in range(follower.n_near):
            n = met[near, m]
            depth = place.size * (field[ONSETS, n] - field[rows + U, m])
            if depth <= 0.0:
                continue
            n_met += 1
            if (n_met - 1) % every == 0:
                force = stiffness * depth
                _show_contact(
                    seat, n_shown, transform, points[n, 0], points[n, 1], points[n, 2],
                    force * field[rows + ALONG, m], force * field[rows + ALONG + 1, m],
                    force * field[rows + ALONG + 2, m],
                )  # fmt: skip
                n_shown += 1
    seat.n_contacts = n_shown
    fence()
    seat.contacts_sequence += 1


@leaf
def show_objects(seat, session):
    """Copy the ids of what is touched from the desk to the board."""
    n_objects = min(session.n_objects, np.int64(MOST_ASKED))
    for n in range(n_objects):
        seat.objects[n] = session.objects[n]
    seat.n_objects = n_objects


@leaf
def count_left_out(seat, left_out):
    """Count the points that the budget left out of a frame, and of its recorded wrench."""
    seat.left_out_frames += left_out > 0
    seat.most_left_out = max(seat.most_left_out, left_out)


@leaf
def count_times(seat, lateness, elapsed):
    """Count a frame's lateness and computing time, seconds."""
    seat.lateness[min(np.int64(lateness / TIME_BIN), np.int64(TIME_BINS))] += 1
    seat.elapsed[min(np.int64(elapsed / TIME_BIN), np.int64(TIME_BINS))] += 1
    seat.worst_lateness = max(seat.worst_lateness, lateness)
    seat.worst_elapsed = max(seat.worst_elapsed, elapsed)
