"""How much one client of the endpoint for cells may ask for, and how many clients there may be."""

from dataclasses import dataclass

MIB = 1 << 20
"""Bytes of a MiB."""


@dataclass(frozen=True)
class CellsLimits:
    """Limits of the endpoint for cells.

    Attributes
    ----------
    clients : int
        Most connections at once. Larger: more clients share the same threads.
    bytes_a_second, burst_bytes : float
        Bytes of answers that one client gets each second on average, and after a pause. Larger: one
        client can fill the network for longer.
    requests_a_second, burst_requests : float
        Requests of one client, likewise. Larger: a flood costs the others more.
    idle_s : float
        Seconds without a message after which a connection is closed. Larger: a vanished client
        holds its place for longer.
    greeting_s : float
        Seconds in which the first message must come. Larger: a silent stranger stays for longer.
    sending_s : float
        Seconds that a client may take to receive one message. Larger: a client that does not read
        stays for longer.
    snapshot_s : float
        Seconds that a client's snapshot is held. Larger: slower clients can end theirs, and the
        database keeps old rows for longer.
    waiting_s : float
        Seconds that a snapshot waits for a free store before the client is told to ask later.
    threads : int
        Statements that run at once. Larger: more of the processor may serve clients of cells.
    snapshots : int
        Snapshots that are held at once; there are `threads` stores more than that.
    """

    clients: int = 64
    bytes_a_second: float = 32.0 * MIB
    burst_bytes: float = 64.0 * MIB
    requests_a_second: float = 2000.0
    burst_requests: float = 1000.0
    idle_s: float = 120.0
    greeting_s: float = 10.0
    sending_s: float = 20.0
    snapshot_s: float = 5.0
    waiting_s: float = 2.0
    threads: int = 4
    snapshots: int = 8


BEAT_S = 0.05
"""Seconds between two BEATs. Larger: a client notices later that server or database hangs."""
NEWS_IN_FLIGHT = 4
"""NEWS that a client may leave unread. Larger: a slow client gets more old ones before the newest;
smaller: over a slow network each NEWS waits for the word that the last one was read."""
MOST_NEWS_CELLS = 384
"""Most cells whose rows one NEWS has. Larger: more cells need no question, a NEWS takes longer."""
MOST_NEWS_BYTES = 768 << 10
"""Most bytes of rows in one NEWS, for the same reason."""
MOST_NEWS_CHANGES = 256
"""Most writes that one NEWS lists. After more, the client asks for them."""
MOST_ANSWER_BYTES = 2 << 20
"""Bytes of rows or objects after which an answer is continued by the next request. Larger: fewer
round trips for large answers, longer waits behind them."""
