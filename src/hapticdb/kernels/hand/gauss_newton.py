"""One Gauss-Newton step of the quasi-static coupling over a predicted contact set.

The tool's pose minimises E = psi(|e|; k, F) + psi(|theta|; k_R, T) + K/2 sum d_i^2 (physics: Wan
and McNeely 2003, Barbic and James 2008), with the stretch e and the turn theta from tool to hand,
and the depths d_i = s (onset_i - u_i). psi is quadratic up to its cap and linear beyond.
"""

import math

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.near_points import depth_of


@leaf
def _add_row(follower, weight, depth, along, about):
    """Add a row J = (along, about) to the step's equations: weight J J^T, and weight d J."""
    matrix, right = follower.matrix, follower.right
    row = along[0], along[1], along[2], about[0], about[1], about[2]
    for n in range(6):
        weighed = weight * row[n]
        for m in range(n + 1):  # lower triangle: symmetric
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
                # the springs make the matrix positive definite: the guard is against rounding alone
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
    """Set the step's equations to the springs alone; the `extra` stiffness only brakes."""
    matrix, right, pull, pulls = follower.matrix, follower.right, follower.pull, follower.pulls
    for row in range(6):
        for column in range(row):
            matrix[row, column] = 0.0
    for axis in range(3):
        # brake on the left side alone (Levenberg-Marquardt): shorter steps, same equilibrium
        matrix[axis, axis] = pulls[0] + extra
        matrix[3 + axis, 3 + axis] = pulls[1] + turn_extra
        right[axis] = pulls[0] * pull[axis]
        right[3 + axis] = pulls[1] * pull[3 + axis]


@leaf
def _predict_contacts(query):
    """Update the contact set to the near points with depth after the step -> whether it changed.

    The depth after the step is d_i - J_i . step, metres.
    """
    follower, near, step = query.follower, query.near[query.follower.side], query.follower.step
    sx, sy, sz, tx, ty, tz = step[0], step[1], step[2], step[3], step[4], step[5]
    n_changed = n_active = 0
    for m in range(follower.n_near):
        one = near[m]
        along, about, depth = one.along, one.about, depth_of(query, one)
        depth -= along[0] * sx + along[1] * sy
        depth -= along[2] * sz + about[0] * tx
        depth -= about[1] * ty + about[2] * tz
        is_active = depth > 0.0
        n_changed += is_active != one.is_active
        one.is_active = is_active
        n_active += is_active
    follower.n_active = n_active
    return n_changed > 0


@leaf
def _add_bends(follower, weight, bends):
    """Add the resistance of a hollow surface across the gradient of a near point.

    Gauss-Newton omits this part of the energy's second derivative, -K d u''; it is added if
    positive. Without it steps in corners overshoot as soon as the force over the voxel size exceeds
    the spring's stiffness.
    """
    for bend in range(2):
        curvature = bends.curvature[bend]
        if curvature > 0.0:
            _add_row(follower, weight * curvature, 0.0, bends.along[bend], bends.about[bend])
            follower.n_bends += 1


@leaf
def solve_step(query, stiffness, extra, turn_extra, rounds):
    """Solve for the step (6,), m and rad about the centre, and its contact set.

    query.follower : e and theta in `pull`, their stiffnesses in `pulls`; stiffness : of a contact,
    N/m; extra, turn_extra : stiffnesses of the brake; rounds : most solutions of the equations
    until the contact set is stable.
    """
    follower, near = query.follower, query.near[query.follower.side]
    follower.n_bends = 0
    for axis in range(6):
        follower.step[axis] = 0.0
    # active set method, begun at step 0 with the present contacts
    _predict_contacts(query)
    for _ in range(rounds):
        _begin_equations(follower, extra, turn_extra)
        for m in range(follower.n_near):
            one = near[m]
            if not one.is_active:
                continue
            depth = depth_of(query, one)  # below 0: the step ends in contact, not beyond it
            _add_row(follower, stiffness, depth, one.along, one.about)
            if follower.is_bent and depth > 0.0 and one.is_hollow:
                weight = stiffness * depth / query.grid.size
                _add_bends(follower, weight, query.bends[follower.side, m])
        _factor(follower)
        _solve(follower)
        # stable set: the step is the minimum of the piecewise quadratic model
        if not _predict_contacts(query):
            return
