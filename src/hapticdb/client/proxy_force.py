"""ProxyForce: the force of contact proxies over time, and its fall to zero when none arrive.

It has no clock and no network of its own, so the rules of safety can be checked step by step.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.hand.steadying import MOST_CHANGE, WINDOW
from hapticdb.kernels.proxy.evaluate import PUSHING, RESULTS, WAY, WRENCH, evaluate
from hapticdb.kernels.records import CONTACT_MODEL
from hapticdb.poses import rotation_of
from hapticdb.protocol.contacts import FINE, IS_LOOSE, IS_WAITING, UNIT, ProxyState, ProxyTerms

Floats = NDArray[np.float64]
Model = NDArray[np.void]
"""A record () of `kernels.records.CONTACT_MODEL`."""

HOLD = 0.020
"""Seconds after a missed proxy for which the last one is used on. Larger: a pause of the network is
felt later, and a stale force lasts longer."""
FADE = 0.020
"""Seconds in which the force then falls to zero, and in which it rises again. Larger: softer."""
OLDEST = 0.25
"""Greatest age of the hand, s, that a proxy answers. An older one counts as not arrived: it waited
in a queue. Larger: slower networks may be used, with more wrong forces."""


class ForceState(NamedTuple):
    """What a wrench was computed from.

    is_fresh : whether a proxy has arrived in time; is_trusted : whether the hand is within its
    trust radius; contacts : number of its planes that push; share : of the force that is sent, 0
    to 1; age : seconds since the hand that the proxy answers, infinite without one.
    """

    is_fresh: bool
    is_trusted: bool
    contacts: int
    share: float
    age: float = math.inf


class ProxyForce:
    """Evaluates the newest proxy, blends it in over one period, and lets the force fall in silence.

    terms : what the server granted; damping : B, N s/m, of the hand's motion along the force.
    """

    def __init__(self, terms: ProxyTerms, damping: float = 0.0) -> None:
        self.terms, self._damping = terms, damping
        self._model: Model | None = None
        self._arrived = -math.inf
        self._next: tuple[Model, float, float] | None = None
        self._answers = -math.inf
        self._offset, self._blended_at = np.zeros(6), -math.inf
        self._plain = np.zeros(6)  # the last wrench before damping and share
        self._result = np.zeros(RESULTS)
        self._risen = 0.0
        self._called: float | None = None
        self._last = np.zeros(3)
        self.told = ForceState(is_fresh=False, is_trusted=False, contacts=0, share=0.0)

    def take(self, proxy: ProxyState, now: float) -> bool:
        """Use a proxy from the next wrench on -> whether it is young enough.

        May be called in another thread than `wrench`. `now` is of the clock of the hands' messages.
        """
        if proxy.flags & IS_WAITING or now - proxy.echo_clock > OLDEST:
            return False
        self._next = (model_of(proxy, self.terms), now, proxy.echo_clock)
        return True

    def wrench(self, hand: Floats, velocity: Floats, now: float) -> Floats:
        """Wrench (6,) on the hand about the handle's origin, N and N m, in the scene.

        hand (7,): position and unit quaternion of the handle; NaN where it is not known. velocity
        (6,): of the handle, m/s and rad/s. now: seconds, of the same clock as `take`.
        """
        newest, self._next = self._next, None
        passed = 0.0 if self._called is None else max(now - self._called, 0.0)
        way = 0.0 if self._called is None else float(np.linalg.norm(hand[:3] - self._last))
        is_somewhere = math.isfinite(hand[0])
        before = self._model
        if newest is not None:
            self._model, self._arrived, self._answers = newest
        self._called = now
        share = self._next_share(now, passed, is_known=is_somewhere)
        if self._model is None or not is_somewhere:
            return self._last_wrench(share)
        self._last[:] = hand[:3]
        left = max(1.0 - (now - self._blended_at) / self.terms.period, 0.0)
        if newest is not None:  # both here: the hand's own way is no difference of the proxies
            self._offset, self._blended_at = left * self._offset - self._at(self._model, hand), now
            self._offset += self._plain if before is None else self._at(before, hand)
            left = 1.0
        wrench = self._at(self._model, hand) + left * self._offset
        self._soften(wrench, passed, way)
        self._plain = wrench
        trusted = bool(self._result[WAY] <= self._model["trust"])
        self.told = ForceState(
            share == 1.0, trusted, int(self._result[PUSHING]), share, now - self._answers
        )
        return share * self._damped(wrench, velocity)

    def _at(self, model: Model, hand: Floats) -> Floats:
        """Wrench (6,) of a proxy with the handle at (7,)."""
        evaluate(model, hand, self._result)
        return self._result[WRENCH : WRENCH + 6].copy()

    def _next_share(self, now: float, passed: float, *, is_known: bool) -> float:
        """Share of the wrench that is sent now."""
        late = now - self._arrived - self.terms.period - HOLD
        fallen = max(1.0 - max(late, 0.0) / FADE, 0.0)
        if is_known and late <= 0.0:
            self._risen = min(self._risen + passed / FADE, 1.0)
        elif not is_known:
            self._risen = max(self._risen - passed / FADE, 0.0)
        self._risen = min(self._risen, fallen)
        return self._risen

    def _last_wrench(self, share: float) -> Floats:
        """Last wrench, faded: there is no place to evaluate anything at."""
        self.told = ForceState(is_fresh=False, is_trusted=False, contacts=0, share=share)
        return share * self._plain

    def _soften(self, wrench: Floats, passed: float, way: float) -> None:
        """Limit the change of the force to what the hand's own way explains, as the loop does."""
        stiffness = self.terms.stiffness + self._damping / WINDOW
        allowed = MOST_CHANGE * passed + stiffness * way
        change = wrench - self._plain
        size = float(np.linalg.norm(change[:3]))
        if size > allowed:
            wrench[:] = self._plain + (allowed / size) * change

    def _damped(self, wrench: Floats, velocity: Floats) -> Floats:
        """Wrench with the damper along the force: at most the cap, and never a pull.

        The torque stays.
        """
        force = float(np.linalg.norm(wrench[:3]))
        if force == 0.0 or self._damping == 0.0:
            return wrench
        speed = float(wrench[:3] @ velocity[:3]) / force
        size = min(force + min(max(-self._damping * speed, -force), force), self.terms.cap)
        damped = wrench.copy()
        damped[:3] *= size / force
        return damped


def model_of(proxy: ProxyState, terms: ProxyTerms) -> Model:
    """Record of `CONTACT_MODEL` from a message."""
    model = np.zeros((), CONTACT_MODEL)
    n, size = len(proxy.planes), terms.voxel_size
    center = rotation_of(proxy.quaternion)[0] @ np.array(terms.center)
    model["hand"][:3], model["hand"][3:] = proxy.position + center, proxy.quaternion
    model["tool"][:3] = model["hand"][:3] + proxy.tool_offset
    model["tool"][3:] = proxy.tool_quaternion
    model["center"], model["radius"], model["trust"] = terms.center, terms.radius, proxy.trust
    model["wrench"], model["stiffness"] = proxy.wrench, proxy.stiffness
    model["spring"], model["turn_spring"] = proxy.spring, proxy.turn_spring
    model["cap"], model["turn_cap"] = terms.cap, terms.turn_cap
    model["contact"], model["onset"] = terms.contact, terms.onset
    model["n_planes"] = 0 if proxy.flags & IS_LOOSE else n
    planes = proxy.planes
    model["levers"][:n] = planes["lever"] * (terms.radius / UNIT)
    model["normals"][:n] = planes["normal"] / UNIT
    model["depths"][:n] = planes["depth"] * (FINE * size)
    model["weights"][:n] = planes["weight"]
    model["bends"][:n] = planes["bends"] * (FINE / size)
    model["along"][:n] = planes["along"] / 127.0
    return model
