"""One Gauss-Newton step of the quasi-static coupling over a predicted contact set.

The tool's pose minimises E = psi(|e|; k, F) + psi(|theta|; k_R, T) + K/2 sum d_i^2 (physics: Wan
and McNeely 2003, Barbic and James 2008), with the stretch e and the turn theta from tool to hand,
and the depths d_i = s (onset_i - u_i). psi is quadratic up to its cap and linear beyond.
"""

import math

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.near_points import (
    ABOUT,
    ACTIVE,
    ALONG,
    BEND_ROWS,
    BENDS,
    NEAR,
    NEAR_POINTS,
    NEAR_ROWS,
    ONSETS,
    U,
)


@leaf
def _add_row(follower, weight, depth, jx, jy, jz, ax, ay, az):
    """Add a row to the step's equations: weight J J^T to the lower triangle, weight d J."""
    matrix, right, row = follower.matrix, follower.right, (jx, jy, jz, ax, ay, az)
    for n in range(6):
        weighed = weight * row[n]
        for m in range(n + 1):
            matrix[n, m] += weighed * row[m]
        right[n] += weighed * depth


@leaf
def _factor(follower):
    """Cholesky factor L of the step's matrix, in its lower triangle."""
    matrix = follower.matrix
    for row in range(6):
        for column in range(row + 1):
            total = matrix[row, column]
            for n in range(column):
                total -= matrix[row, n] * matrix[column, n]
            if row == column:
                matrix[row, row] = math.sqrt(max(total, 1e-300))
            else:
                matrix[row, column] = total / matrix[column, column]


@leaf
def _solve(follower):
    """Solve the step's equations by the factor L of their matrix: step = L^-T L^-1 right."""
    matrix, right, step = follower.matrix, follower.right, follower.step
    for row in range(6):
        total = right[row]
        for n in range(row):
            total -= matrix[row, n] * step[n]
        step[row] = total / matrix[row, row]
    for back in range(6):
        row = 5 - back
        total = step[row]
        for n in range(row + 1, 6):
            total -= matrix[n, row] * step[n]
        step[row] = total / matrix[row, row]


@leaf
def _begin_equations(follower, extra, turn_extra):
    """Set the step's equations to the springs alone, and `extra` stiffness that only brakes."""
    matrix, right, pull, pulls = follower.matrix, follower.right, follower.pull, follower.pulls
    for row in range(6):
        for column in range(row):
            matrix[row, column] = 0.0
    for axis in range(3):
        matrix[axis, axis] = pulls[0] + extra
        matrix[3 + axis, 3 + axis] = pulls[1] + turn_extra
        right[axis] = pulls[0] * pull[axis]
        right[3 + axis] = pulls[1] * pull[3 + axis]


@leaf
def _predict_contacts(follower, field, met, size):
    """Put the near points that the step leaves in depth into the contact set -> whether it changed.

    The depth after the step is d_i - J_i . step, metres.
    """
    step = follower.step
    sx, sy, sz, tx, ty, tz = step[0], step[1], step[2], step[3], step[4], step[5]
    base = NEAR + follower.side * NEAR_ROWS
    near = NEAR_POINTS + follower.side
    n_changed = n_active = 0
    for m in range(follower.n_near):
        depth = size * (field[ONSETS, met[near, m]] - field[base + U, m])
        depth -= field[base + ALONG, m] * sx + field[base + ALONG + 1, m] * sy
        depth -= field[base + ALONG + 2, m] * sz + field[base + ABOUT, m] * tx
        depth -= field[base + ABOUT + 1, m] * ty + field[base + ABOUT + 2, m] * tz
        active = 1.0 if depth > 0.0 else 0.0
        if active != field[ACTIVE, m]:
            n_changed += 1
            field[ACTIVE, m] = active
        n_active += depth > 0.0
    follower.n_active = n_active
    return n_changed > 0


@leaf
def _add_bends(follower, weight, field, rows, m):
    """Add the resistance of a hollow surface across the gradient of near point m.

    It is the part of the energy's second derivative that Gauss-Newton leaves out, -K d u'', where
    it is positive. Without it steps in corners overshoot as soon as the force over the voxel size
    exceeds the spring's stiffness.
    """
    for bend in range(2):
        row = rows + BENDS + bend * BEND_ROWS
        if field[row, m] > 0.0:
            _add_row(
                follower, weight * field[row, m], 0.0,
                field[row + 1, m], field[row + 2, m], field[row + 3, m],
                field[row + 4, m], field[row + 5, m], field[row + 6, m],
            )  # fmt: skip
            follower.n_bends += 1


@leaf
def solve_step(follower, field, met, size, stiffness, extra, turn_extra, rounds):
    """Solve for the step (6,), m and rad about the centre, and its contact set.

    follower: a record of FOLLOWER, of which pull has e and theta, and pulls their stiffnesses;
    stiffness: of a contact, N/m; rounds: most times that the equations are solved until the contact
    set stays the same.
    """
    step = follower.step
    base = NEAR + follower.side * NEAR_ROWS
    near = NEAR_POINTS + follower.side
    follower.n_bends = 0
    for axis in range(6):
        step[axis] = 0.0
    _predict_contacts(follower, field, met, size)
    for _ in range(rounds):
        _begin_equations(follower, extra, turn_extra)
        for m in range(follower.n_near):
            if field[ACTIVE, m] == 0.0:
                continue
            depth = size * (field[ONSETS, met[near, m]] - field[base + U, m])
            _add_row(
                follower, stiffness, depth,
                field[base + ALONG, m], field[base + ALONG + 1, m], field[base + ALONG + 2, m],
                field[base + ABOUT, m], field[base + ABOUT + 1, m], field[base + ABOUT + 2, m],
            )  # fmt: skip
            if follower.is_bent and depth > 0.0:
                _add_bends(follower, stiffness * depth / size, field, base, m)
        _factor(follower)
        _solve(follower)
        if not _predict_contacts(follower, field, met, size):
            return
