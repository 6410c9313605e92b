"""ContactProxy: feel an environment on a server, by proxies of the contacts near the hand.

    with ContactProxy("ws://server:8080", tool="wrench") as proxy:
        while True:  # 1000 times a second
            device.apply(proxy.wrench(pose, velocity))

The network has threads of its own, so `wrench` never waits: it evaluates the newest proxy where the
hand is now. If the server is late, stops or vanishes, the force falls to zero here.
"""

import math
import threading
import time
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.client.contact_connection import ContactConnection, connect
from hapticdb.client.proxy_force import ForceState, ProxyForce
from hapticdb.closing import Closes
from hapticdb.devices.profiles import HAND_STIFFNESS
from hapticdb.devices.protocol import Reading
from hapticdb.errors import ConnectionLostError, HapticDBError, UsageError
from hapticdb.kernels.records import HAND, pose_numbers
from hapticdb.protocol.contacts import HandState, ProxyTerms, ProxyWish
from hapticdb.ready import make_ready
from hapticdb.realtime.handle import Handle

Floats = NDArray[np.float64]

HANDS_A_SECOND = 200.0
"""Hands sent a second. Larger: the server's proxy answers a newer hand, by half of a period."""
SILENT_AFTER = 0.25
"""Seconds without a proxy after which hands are sent seldom: nothing may queue in a network that
does not move."""
SILENT_RATE = 5.0
"""Hands sent a second then."""
RECONNECT_EVERY = 1.0
"""Seconds between two attempts to reach a server that has vanished."""
PATIENCE = 10.0
"""Seconds in which a server must answer at first."""


class _LinkFigures(NamedTuple):
    """Figures of a connection so far.

    proxies, late : proxies that arrived, and those of them that were too old to use; bytes : of all
    proxies; losses : how often the connection was lost.
    """

    proxies: int
    late: int
    bytes: int
    losses: int


class ContactProxy(Closes):
    """A hand in an environment on a server. Also a context manager.

    Parameters
    ----------
    url : str
        Of the server: ``ws://host:port``, or ``wss://``. Its token may be given as ``?token=``, or
        in the environment variable HAPTICDB_TOKEN.
    tool : str
        Name of one of the server's tools; may be empty if it has only one.
    stiffness, cap, turn_stiffness, torque_cap : float or None
        Of the spring between hand and tool, at the device: N/m, N, N m/rad, N m. None: 1000 N/m
        and 7 N; turns follow from them and the tool's size. Choose them as your device allows: see
        `hapticdb.devices.stability`.
    damping : float or None
        B, N s/m at the device, along the force. None: half a period at 1 kHz times the stiffness.
    handle : Handle or None
        Mapping of the hand to the scene: scale and clutch.

    Raises
    ------
    UsageError
        If the URL or a number is wrong, or the server has no such tool.
    AccessError
        If the server refuses the token, or its certificate is not trusted.
    BusyError
        If the server has too many clients.
    ConnectionLostError
        If the server cannot be reached.
    EnvironmentNotFoundError
        If another server answers there.
    """

    def __init__(
        self,
        url: str,
        tool: str = "",
        *,
        stiffness: float | None = None,
        cap: float | None = None,
        turn_stiffness: float | None = None,
        torque_cap: float | None = None,
        damping: float | None = None,
        handle: Handle | None = None,
    ) -> None:
        if damping is not None and not 0.0 <= damping < math.inf:
            raise UsageError(f"a damping of {damping} N s/m: give 0 or more")
        make_ready("proxy")
        self.handle = handle or Handle()
        scale = self.handle.scale
        self._wish = ProxyWish(
            tool, (HAND_STIFFNESS if stiffness is None else stiffness) / scale,
            (turn_stiffness or 0.0) * scale, cap or 0.0, (torque_cap or 0.0) * scale,
        )  # fmt: skip
        self._url = url
        self._is_closed = threading.Event()
        self._hand = np.zeros((), HAND)
        self._numbers = pose_numbers(self._hand)
        self._is_placed = False
        self._newest: tuple[float, Floats, Floats, int, bool] | None = None
        self._connection: ContactConnection | None = connect(url, self._wish, PATIENCE)
        self.terms: ProxyTerms = self._connection.terms
        """What the server granted, in the scene's units."""
        given = 0.5e-3 * self.terms.stiffness * scale if damping is None else damping
        self._force = ProxyForce(self.terms, given / scale)
        self.error: HapticDBError | None = None
        """Why the server is not reached now; None while it is."""
        self._arrived = time.monotonic()
        self._counts = [0, 0, 0, 0]  # proxies, late, bytes, losses
        self._seen = 0
        self._threads = [
            threading.Thread(target=target, daemon=True, name=name)
            for target, name in ((self._receive, "proxies"), (self._send, "hands"))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._is_closed.is_set():
            return
        self._is_closed.set()
        connection = self._connection
        if connection is not None:
            connection.close()
        for thread in self._threads:
            thread.join(PATIENCE)

    def wrench(self, pose: ArrayLike, velocity: ArrayLike, buttons: int = 0) -> Floats:
        """Wrench for the device, now. It does not wait; call it in each period of your loop.

        Parameters
        ----------
        pose : array_like
            (4, 4) of the hand, metres of the device.
        velocity : array_like
            (6,) of the hand: m/s, then rad/s, of the device.
        buttons : int
            A bit for each button that is held down.

        Returns
        -------
        ndarray
            (6,): N, and N m about the hand's origin, device's axes. Zero where nothing is touched,
            while the clutch is open, and when the server is silent.
        """
        reading = Reading(np.asarray(pose, float), np.asarray(velocity, float), buttons)
        if self._is_placed:
            self.handle.follow(reading, self._hand)
        else:
            self.handle.start(reading, self._hand)
            self._is_placed = True
        now = time.monotonic()
        hand, is_open = self._numbers.copy(), bool(self._hand["is_open"])
        moving = np.array(self._hand["velocity"])
        self._newest = (now, hand, moving, buttons, is_open)
        if is_open:
            hand = np.full(7, np.nan)  # the force falls as it does without a place
        wrench = self._force.wrench(hand, moving, now)
        wrench[3:] /= self.handle.scale
        return wrench

    @property
    def told(self) -> ForceState:
        """What the last wrench was computed from."""
        return self._force.told

    def figures(self) -> _LinkFigures:
        """Figures of the connection so far."""
        return _LinkFigures(*self._counts)

    # -- the network's threads -----------------------------------------------------------------

    def _receive(self) -> None:
        """Take proxies as they come; connect again when the connection is lost."""
        while not self._is_closed.is_set():
            connection = self._connection
            if connection is None:
                self._reconnect()
                continue
            try:
                proxy, size = connection.receive()
            except HapticDBError as error:
                self._lose(connection, error)
                continue
            now = time.monotonic()
            self._arrived, self._seen = now, proxy.sequence
            counts = self._counts
            counts[0] += 1
            counts[1] += not self._force.take(proxy, now)
            counts[2] += size

    def _lose(self, connection: ContactConnection, error: HapticDBError) -> None:
        if self._is_closed.is_set():
            return
        self.error, self._connection = error, None
        self._counts[3] += 1
        connection.close()

    def _reconnect(self) -> None:
        if self._is_closed.wait(RECONNECT_EVERY):
            return
        try:
            connection = connect(self._url, self._wish, PATIENCE)
        except HapticDBError as error:
            self.error = error
            return
        if connection.terms != self.terms:
            connection.close()
            self.error = UsageError("the server has come back with another tool: connect anew")
            return
        self._connection, self.error = connection, None
        if self._is_closed.is_set():  # `close` may have looked before the connection was there
            connection.close()

    def _send(self) -> None:
        """Send the newest hand again and again."""
        sequence = 0
        due = time.monotonic()
        while not self._is_closed.is_set():
            is_silent = time.monotonic() - self._arrived > SILENT_AFTER
            due = max(due + 1.0 / (SILENT_RATE if is_silent else HANDS_A_SECOND), time.monotonic())
            newest, connection = self._newest, self._connection
            if newest is not None and connection is not None and np.isfinite(newest[1]).all():
                sequence += 1
                clock, hand, velocity, buttons, is_open = newest
                state: dict[str, Any] = {"buttons": buttons, "seen": self._seen, "is_open": is_open}
                with suppress(ConnectionLostError):  # the receiving thread sees it, too
                    connection.send(
                        HandState(sequence, clock, hand[:3], hand[3:], velocity, **state)
                    )
            time.sleep(max(due - time.monotonic(), 0.0))
