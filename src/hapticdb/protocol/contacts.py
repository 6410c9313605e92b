"""Messages of contact proxies, to the byte: docs/protocol.md, "Contacts", has every field.

All numbers are little-endian. Each message is checked as it is read: its length must be exactly
what its fields need, every number must be finite, and quaternions must have unit length.
"""

import struct
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import ProtocolError
from hapticdb.protocol.header import LAYOUT, Kind, MessageHeader, header_of

Floats = NDArray[np.float64]

IS_OPEN, IS_LOOSE, IS_WAITING = 1, 2, 4
"""Flags. Of a hand: the clutch is open, so nothing is felt. Of a proxy: the tool lies in something,
and feels nothing until it is free; the cells near the tool are not in memory yet."""
MOST_PLANES = 16
"""Most planes of a proxy. Larger: tools that touch in many places are modelled more closely."""
MOST_NAME = 64
"""Most bytes of a tool's name."""
UNIT = 32767.0
"""The number that stands for 1 in a normal, and for the tool's radius in a lever."""
FINE = 1.0 / 8192.0
"""Step of depths, in voxels, and of curvatures, in 1/voxel. Both reach to 4 voxels."""
FARTHEST = 1e9
"""Largest credible coordinate of a place, metres. A larger one is malformed."""
LARGEST = 1e6
"""Largest credible speed, force, torque or stiffness of a spring. A larger one is malformed."""
STIFFEST = 1e12
"""Largest credible stiffness of a contact, N/m: it grows as voxels get smaller, since one point
stops a spring's force within a part of a voxel."""
SKEW = 1e-3
"""Greatest difference of a quaternion's length from 1."""

HAND_BODY = np.dtype(
    [
        ("clock", "<f8"),
        ("position", "<f8", 3),
        ("quaternion", "<f4", 4),
        ("velocity", "<f4", 6),
        ("buttons", "<u4"),
        ("seen", "<u4"),
        ("flags", "<u4"),
    ]
)
"""Body of a hand's message: 84 bytes, without gaps."""
PROXY_BODY = np.dtype(
    [
        ("echo", "<u4"),
        ("flags", "<u2"),
        ("n_planes", "<u2"),
        ("clock", "<f8"),
        ("echo_clock", "<f8"),
        ("kept", "<f4"),
        ("trust", "<f4"),
        ("position", "<f8", 3),
        ("quaternion", "<f4", 4),
        ("tool_offset", "<f4", 3),
        ("tool_quaternion", "<f4", 4),
        ("wrench", "<f4", 6),
        ("stiffness", "<f4", 21),
        ("spring", "<f4"),
        ("turn_spring", "<f4"),
    ]
)
"""Body of a proxy's message up to its planes: 216 bytes, without gaps."""
PLANE = np.dtype(
    [
        ("lever", "<i2", 3),
        ("normal", "<i2", 3),
        ("depth", "<i2"),
        ("weight", "<u2"),
        ("bends", "<i2", 2),
        ("along", "i1", 3),
        ("reserved", "u1"),
    ]
)
"""One plane of a proxy: 24 bytes, without gaps."""
LOWER = np.tril_indices(6)
"""Rows and columns of the 21 numbers of K6: its lower triangle, row by row."""


class ProxyWish(NamedTuple):
    """What a client asks for at first: body of its HELLO.

    tool : name of one of the server's tools, empty for the only one; stiffness N/m, turn_stiffness
    N m/rad, cap N and turn_cap N m of the spring between hand and tool, 0 for the server's choice.
    """

    tool: str = ""
    stiffness: float = 0.0
    turn_stiffness: float = 0.0
    cap: float = 0.0
    turn_cap: float = 0.0


class ProxyTerms(NamedTuple):
    """What the server grants: body of its WELCOME.

    center (3,) : the tool's centre in the tool's frame, m; radius : of its farthest point, m;
    stiffness, turn_stiffness, cap, turn_cap : of the spring; contact : stiffness of one contact
    point, N/m; voxel_size, m; onset : distance from a surface at which contact begins, m; period :
    seconds from one proxy to the next.
    """

    tool: str
    center: tuple[float, float, float]
    radius: float
    stiffness: float
    turn_stiffness: float
    cap: float
    turn_cap: float
    contact: float
    voxel_size: float
    onset: float
    period: float


@dataclass(frozen=True)
class HandState:
    """A hand's message.

    sequence : grows by 1; clock : the client's, s; position (3,) m and unit quaternion (4,), scalar
    first, of the handle; velocity (6,) m/s, rad/s; all in the scene; buttons : a bit for each; seen
    : sequence of the newest proxy that has arrived; is_open : nothing is to be felt.
    """

    sequence: int
    clock: float
    position: Floats
    quaternion: Floats
    velocity: Floats
    buttons: int = 0
    seen: int = 0
    is_open: bool = False


@dataclass(frozen=True)
class ProxyState:
    """A proxy's message; see `hapticdb.kernels.records.CONTACT_MODEL` for the numbers' meaning.

    sequence, revision : of this message, and of the environment; echo, echo_clock : sequence and
    clock of the hand that it answers; kept : seconds from that hand's arrival to this message;
    clock : the server's, s; flags; trust, m; position, quaternion : of the handle; tool_offset (3,)
    : from the tool's centre as the hand holds it to the tool's centre, m; tool_quaternion; wrench
    (6,); stiffness (6, 6); spring N/m, turn_spring N m/rad; planes (n,) of `PLANE`.
    """

    sequence: int
    revision: int
    echo: int
    echo_clock: float
    kept: float
    clock: float
    flags: int
    trust: float
    position: Floats
    quaternion: Floats
    tool_offset: Floats
    tool_quaternion: Floats
    wrench: Floats
    stiffness: Floats
    spring: float
    turn_spring: float
    planes: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, PLANE))


def pack_wish(wish: ProxyWish) -> bytes:
    """Bytes of a client's HELLO."""
    return _packed(Kind.HELLO, *wish)


def unpack_wish(message: bytes) -> ProxyWish:
    """Read a client's HELLO; ProtocolError if it is malformed."""
    tool, numbers = _unpacked(message, Kind.HELLO, 4)
    if len(tool.encode()) > MOST_NAME:
        raise ProtocolError(f"a tool's name of more than {MOST_NAME} bytes")
    _check_range("a spring", np.array(numbers), 0.0, LARGEST)
    return ProxyWish(tool, *numbers)


def pack_terms(terms: ProxyTerms) -> bytes:
    """Bytes of the server's WELCOME."""
    return _packed(Kind.WELCOME, terms.tool, *terms.center, *terms[2:])


def unpack_terms(message: bytes) -> ProxyTerms:
    """Read the server's WELCOME; ProtocolError if it is malformed."""
    tool, (x, y, z, *numbers) = _unpacked(message, Kind.WELCOME, 12)
    _check_range("a centre", np.array([x, y, z]), -FARTHEST, FARTHEST)
    for name, number in zip(ProxyTerms._fields[2:], numbers, strict=True):
        most = STIFFEST if name == "contact" else LARGEST
        if not 0.0 < number <= most:
            raise ProtocolError(
                f"a WELCOME whose {name} is {number:g}: it must be above 0, {most:g} at most"
            )
    return ProxyTerms(tool, (x, y, z), *numbers)


def pack_hand(hand: HandState) -> bytes:
    """Bytes of a hand's message: 100."""
    body = np.zeros((), HAND_BODY)
    body["clock"], body["position"], body["quaternion"] = hand.clock, hand.position, hand.quaternion
    body["velocity"], body["buttons"], body["seen"] = hand.velocity, hand.buttons, hand.seen
    body["flags"] = IS_OPEN if hand.is_open else 0
    return MessageHeader(Kind.HAND, hand.sequence).packed() + body.tobytes()


def unpack_hand(message: bytes) -> HandState:
    """Read a hand's message; ProtocolError if it is malformed."""
    header, body, rest = _parts(message, Kind.HAND, HAND_BODY)
    if rest:
        raise ProtocolError(f"a message with {len(rest)} bytes after its last field")
    position, velocity = body["position"].copy(), body["velocity"].astype(np.float64)
    _check_range("a hand", position, -FARTHEST, FARTHEST)
    _check_range("a hand", velocity)
    if not np.isfinite(body["clock"]):
        raise ProtocolError("a clock that is not finite")
    return HandState(
        header.number, float(body["clock"]), position, _unit(body["quaternion"]), velocity,
        int(body["buttons"]), int(body["seen"]), bool(body["flags"] & IS_OPEN),
    )  # fmt: skip


def pack_proxy(proxy: ProxyState) -> bytes:
    """Bytes of a proxy's message: 232, and 24 for each plane."""
    body = np.zeros((), PROXY_BODY)
    for name in PROXY_BODY.names or ():
        if name not in ("n_planes", "stiffness"):
            body[name] = getattr(proxy, name)
    body["n_planes"], body["stiffness"] = len(proxy.planes), proxy.stiffness[LOWER]
    header = MessageHeader(Kind.PROXY, proxy.sequence, proxy.revision)
    return header.packed() + body.tobytes() + proxy.planes.tobytes()


def unpack_proxy(message: bytes) -> ProxyState:
    """Read a proxy's message; ProtocolError if it is malformed."""
    header, body, rest = _parts(message, Kind.PROXY, PROXY_BODY)
    n_planes = int(body["n_planes"])
    if n_planes > MOST_PLANES:
        raise ProtocolError(f"a proxy of {n_planes} planes: at most {MOST_PLANES} may be sent")
    if len(rest) != n_planes * PLANE.itemsize:
        raise ProtocolError(f"a proxy of {n_planes} planes in {len(rest)} bytes")
    planes = np.frombuffer(rest, PLANE).copy()
    wrench, lower = body["wrench"].astype(np.float64), body["stiffness"].astype(np.float64)
    offset = body["tool_offset"].astype(np.float64)
    position = body["position"].copy()
    _check_range("a proxy", position, -FARTHEST, FARTHEST)
    _check_range("a proxy", np.concatenate([wrench, lower, offset]))
    times = np.array([body["clock"], body["echo_clock"], body["kept"]], dtype=np.float64)
    if not np.isfinite(times).all():
        raise ProtocolError("a proxy with a clock that is not finite")
    springs = np.array([body["spring"], body["turn_spring"], body["trust"]], dtype=np.float64)
    _check_range("a proxy", springs, 0.0, LARGEST)
    stiffness = np.zeros((6, 6))
    stiffness[LOWER] = lower
    stiffness.T[LOWER] = lower
    return ProxyState(
        header.number, header.revision, int(body["echo"]), float(times[1]), float(times[2]),
        float(times[0]), int(body["flags"]), float(springs[2]), position, _unit(body["quaternion"]),
        offset, _unit(body["tool_quaternion"]), wrench, stiffness, float(springs[0]),
        float(springs[1]), planes,
    )  # fmt: skip


def _packed(kind: Kind, text: str, *numbers: float) -> bytes:
    """Bytes of a message of one text and some numbers."""
    data = text.encode("utf-8", "replace")
    body = struct.pack(f"<I{len(data)}s{len(numbers)}d", len(data), data, *numbers)
    return MessageHeader(kind).packed() + body


def _unpacked(message: bytes, kind: Kind, count: int) -> tuple[str, list[float]]:
    """Read a message of one text and so many numbers."""
    _expect(message, kind)
    start = LAYOUT.size + 4
    end = len(message) - 8 * count
    if end < start or struct.unpack_from("<I", message, LAYOUT.size) != (end - start,):
        raise ProtocolError(f"a message of {len(message)} bytes, which are not those of its fields")
    try:
        text = message[start:end].decode()
    except UnicodeDecodeError:
        raise ProtocolError("a text that is no UTF-8") from None
    return text, list(struct.unpack_from(f"<{count}d", message, end))


def _parts(
    message: bytes, kind: Kind, layout: np.dtype[np.void]
) -> tuple[MessageHeader, np.void, bytes]:
    """Header and body of a message, and the bytes behind them."""
    header = _expect(message, kind)
    end = LAYOUT.size + layout.itemsize
    if len(message) < end:
        raise ProtocolError(f"a message that ends after {len(message)} bytes, inside a field")
    return header, np.frombuffer(message, layout, 1, LAYOUT.size)[0], message[end:]


def _expect(message: bytes, kind: Kind) -> MessageHeader:
    header = header_of(message)
    if header.kind != kind:
        raise ProtocolError(f"a message of kind {header.kind}, where {kind.name} must come")
    return header


def _check_range(
    what: str, numbers: Floats, least: float = -LARGEST, most: float = LARGEST
) -> None:
    if not ((numbers >= least) & (numbers <= most)).all():  # NaN fails, too
        raise ProtocolError(f"{what} with a number that is not finite or out of its range")


def _unit(quaternion: NDArray[np.float32]) -> Floats:
    """Quaternion (4,) of unit length from one that was rounded."""
    numbers = quaternion.astype(np.float64)
    length = float(np.sqrt((numbers * numbers).sum()))
    if not abs(length - 1.0) <= SKEW:
        raise ProtocolError("a quaternion that has not the length 1")
    return np.asarray(numbers / length)
