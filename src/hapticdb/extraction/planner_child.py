"""The planner's process: OMPL's RRT-Connect, with motion queries sent to the search.

A process, because OMPL prints reports when it is unloaded, and must end at any time. It neither
reads the database nor loads numba.
"""

import os
from typing import Any, NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.errors import MissingExtraError, pip_line
from hapticdb.session.processes.process import MessageSender, receive_from_parent

SHORTCUTS = 60
"""Attempts to shorten a path. Larger: shorter paths with fewer poses, more motion queries."""


class PlanRequest(NamedTuple):
    """Request to the planner.

    States are rows of position (m) and unit quaternion, scalar first. starts (S, 7), goals (G, 7);
    low, high (3,) : box of the positions; turning : weight of a turn, metres a radian, or 0 for
    shifts alone; stride : greatest distance of neighbouring states; seed; most_motions : motion
    queries, at most.
    """

    starts: Floats
    goals: Floats
    low: Floats
    high: Floats
    turning: float
    stride: float
    seed: int
    most_motions: int


def plan(request: PlanRequest, sender: MessageSender) -> None:
    """Search for a path and send it: a message ``motion`` is a query, ``path`` is the last one.

    Raises `MissingExtraError` if OMPL is not installed.
    """
    try:
        import ompl  # noqa: F401, PLC0415 - only in this process
    except ImportError as error:
        raise MissingExtraError(
            "to turn a part or to go round corners, the search needs the planner OMPL: "
            f"{pip_line('extract')}"
        ) from error
    sender.send("path", _Search(request, sender).path())


class _Search:
    """State space, motion queries and planner of one search."""

    def __init__(self, request: PlanRequest, sender: MessageSender) -> None:
        from ompl import base, util  # noqa: PLC0415

        util.noOutputHandler()
        util.RNG.setSeed(request.seed + 1)  # 0 would mean a seed by the clock
        self._request, self._sender = request, sender
        self._base = base
        self.n_motions = 0
        bounds = base.RealVectorBounds(3)
        for axis in range(3):
            bounds.setLow(axis, float(request.low[axis]))
            bounds.setHigh(axis, float(request.high[axis]))
        if request.turning > 0.0:
            self._space = base.SE3StateSpace()
            self._space.setSubspaceWeight(1, request.turning)
        else:
            self._space = base.RealVectorStateSpace(3)
        self._space.setBounds(bounds)
        self._info = base.SpaceInformation(self._space)
        # a state is a motion without length: one kind of query for both
        self._info.setStateValidityChecker(lambda state: self._is_free(state, state))
        self._info.setMotionValidator(self._motion_validator())
        self._info.setup()

    def path(self) -> Floats | None:
        """States (n, 7) of a shortened path; None without one."""
        from ompl import geometric  # noqa: PLC0415

        problem = self._base.ProblemDefinition(self._info)
        for row in self._request.starts:
            problem.addStartState(self._state(row))
        goals = self._base.GoalStates(self._info)
        for row in self._request.goals:
            goals.addState(self._state(row))
        problem.setGoal(goals)
        planner = geometric.RRTConnect(self._info)
        planner.setRange(self._request.stride)
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(self._base.PlannerTerminationCondition(lambda: self._is_spent))
        if not problem.hasExactSolution():
            return None
        found = problem.getSolutionPath()
        shorter = geometric.PathSimplifier(self._info)
        self.n_motions -= self._request.most_motions  # as many queries again for shortcuts
        # limits of steps, not of seconds: the same seed gives the same path
        shorter.reduceVertices(found, SHORTCUTS, SHORTCUTS)
        shorter.partialShortcutPath(found, SHORTCUTS, SHORTCUTS)
        shorter.collapseCloseVertices(found, SHORTCUTS, SHORTCUTS)
        return np.array([self._row(state) for state in found.getStates()])

    @property
    def _is_spent(self) -> bool:
        return self.n_motions >= self._request.most_motions

    def _motion_validator(self) -> Any:  # noqa: ANN401 - OMPL has no types
        search, validator = self, self._base.MotionValidator

        class QueryValidator(validator):  # type: ignore[misc, valid-type]
            def checkMotion(self, start: Any, end: Any) -> bool:  # noqa: ANN401, N802 - OMPL's name
                return search._is_free(start, end)

        return QueryValidator(self._info)

    def _is_free(self, start: Any, end: Any) -> bool:  # noqa: ANN401
        """Query the search whether a motion is free; False once the queries are spent."""
        if self._is_spent:
            return False
        self.n_motions += 1
        self._sender.send("motion", np.stack([self._row(start), self._row(end)]))
        try:
            return bool(receive_from_parent())
        except SystemExit:  # the search has ended: no exception may pass through OMPL
            os._exit(0)

    def _state(self, row: Floats) -> Any:  # noqa: ANN401
        state = self._info.allocState()
        x, y, z, qw, qx, qy, qz = map(float, row)
        if self._request.turning > 0.0:
            state.setXYZ(x, y, z)
            turn = state.rotation()
            turn.w, turn.x, turn.y, turn.z = qw, qx, qy, qz
        else:
            state[0], state[1], state[2] = x, y, z
        return state

    def _row(self, state: Any) -> Floats:  # noqa: ANN401
        if self._request.turning > 0.0:
            turn = state.rotation()
            place = (state.getX(), state.getY(), state.getZ())
            return np.array([*place, turn.w, turn.x, turn.y, turn.z])
        return np.array([state[0], state[1], state[2], 1.0, 0.0, 0.0, 0.0])
