"""How much a client may ask for: rates, sizes, numbers and times, each with its reason.

docs/serving.md has these figures in a table, and a test compares them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What one server allows. Each default suits a workshop of a dozen people on one machine.

    Attributes
    ----------
    browsers : int
        Browser tabs connected at once. Larger: more sessions share the machine's time.
    browsers_per_second, browsers_at_once : float
        New connections of browsers, on average and in a burst. Larger: a page that is opened again
        and again costs others more time.
    messages_per_second, messages_at_once : float
        Messages of one browser. A hand on the gizmo sends about 20 a second, the camera 50.
        Larger: one browser may take more of the relay's time.
    bytes_per_second, bytes_at_once : float
        Bytes of one browser's messages.
    bad_messages : int
        Messages of one connection that do not pass, before it is closed. Larger: a broken client
        fills logs and counters longer.
    throttled_seconds : float
        Longest time that a browser is throttled without a pause, before it is closed.
    idle_seconds : float
        Time without any message of a browser, after which it is closed. Larger: forgotten tabs
        hold their sessions longer.
    sign_ins_per_second, sign_ins_at_once : float
        Tokens that are tried in browsers, by all clients together. Larger: one is guessed sooner.
        Tokens of programs are not counted: their length alone protects them.
    form_bytes : int
        Bytes of a sign-in form.
    connections : int
        TCP connections at once; more are answered with 503.
    silent : int
        Connections at once whose next request has not come. One more cuts the one that has waited
        longest, so that idle clients leave room for others. Larger: more browsers keep theirs.
    request_seconds : float
        Time for the headers of each request of a connection, and for a form. Larger: slow clients
        hold connections longer.
    fragments : int
        Pieces of one WebSocket message. Larger: empty pieces cost more memory.
    pings_per_second, pings_at_once : float
        WebSocket pings and pongs of one client.
    stop_seconds : float
        Time for connections to end after SIGTERM, before they are cut.
    """

    browsers: int = 32
    browsers_per_second: float = 10.0
    browsers_at_once: float = 40.0
    messages_per_second: float = 200.0
    messages_at_once: float = 400.0
    bytes_per_second: float = 256.0 * 1024
    bytes_at_once: float = 1024.0 * 1024
    bad_messages: int = 100
    throttled_seconds: float = 10.0
    idle_seconds: float = 3600.0
    sign_ins_per_second: float = 1.0
    sign_ins_at_once: float = 10.0
    form_bytes: int = 2048
    connections: int = 512
    silent: int = 128
    request_seconds: float = 10.0
    fragments: int = 64
    pings_per_second: float = 2.0
    pings_at_once: float = 20.0
    stop_seconds: float = 5.0


class TokenBucket:
    """Lets an amount pass each second, on average, and a burst at once after a pause."""

    def __init__(
        self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.rate = rate
        self.burst = burst
        self._clock = clock
        self._left = burst
        self._at = clock()

    def take(self, amount: float = 1.0) -> bool:
        """Take an amount, if there is enough; returns whether there was."""
        self._fill()
        if amount > self._left:
            return False
        self._left -= amount
        return True

    def wait(self, amount: float = 1.0) -> float:
        """Seconds until that amount can be taken; infinite if it never can."""
        if amount > self.burst:
            return float("inf")
        self._fill()
        return max(amount - self._left, 0.0) / self.rate

    def _fill(self) -> None:
        now = self._clock()
        self._left = min(self.burst, self._left + (now - self._at) * self.rate)
        self._at = now
