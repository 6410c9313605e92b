"""What all messages have in common: header, kinds, close codes (docs/protocol.md)."""

import struct
from enum import IntEnum
from typing import NamedTuple

from hapticdb.errors import ProtocolError

MAGIC = b"hd"
"""First two bytes of each message."""
VERSION = 1
"""Version of all layouts. It grows when an older peer would misread a layout."""
LAYOUT = struct.Struct("<2sBBIq")
"""Magic, version, kind, number, revision: 16 bytes, little-endian."""
NO_REVISION = -1
"""Revision of a message that tells of none."""


class Kind(IntEnum):
    """What a message is."""

    HELLO = 1
    WELCOME = 2
    HAND = 128
    PROXY = 129


class CloseCode(IntEnum):
    """Why the server closed a connection, as the code of WebSocket's close frame."""

    MALFORMED = 4400
    IDLE = 4408
    VERSION = 4426
    FAILED = 4500


class OtherVersionError(ProtocolError):
    """A message of another version of the protocol."""


class MessageHeader(NamedTuple):
    """The first 16 bytes of a message.

    kind : what the message is, a `Kind` where it is known; number : of a hand or a proxy, which
    grows by 1; revision : of the environment, in a proxy.
    """

    kind: int
    number: int = 0
    revision: int = NO_REVISION

    def packed(self) -> bytes:
        """The header's bytes."""
        return LAYOUT.pack(MAGIC, VERSION, self.kind, self.number, self.revision)


def header_of(message: bytes) -> MessageHeader:
    """Read a message's header.

    Raises
    ------
    ProtocolError
        When the message is too short or is no message of hapticdb.
    OtherVersionError
        When it has another version.
    """
    if len(message) < LAYOUT.size:
        raise ProtocolError(f"a message of {len(message)} bytes: a header has {LAYOUT.size}")
    magic, version, kind, number, revision = LAYOUT.unpack_from(message)
    if magic != MAGIC:
        raise ProtocolError("a message that does not begin with 'hd'")
    if version != VERSION:
        raise OtherVersionError(
            f"a message of version {version}, where version {VERSION} is spoken: "
            "install the same hapticdb on both sides"
        )
    return MessageHeader(kind, number, revision)
