"""What all messages have in common: header, kinds, refusals, close codes (docs/protocol.md)."""

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
MOST_TEXT = 1 << 16
"""Most bytes of a text in UTF-8. Larger: a peer that means harm makes the other hold more."""
NO_NUMBER = 0
"""Number of a message that answers no request."""
NO_REVISION = -1
"""Revision of a message that tells of none."""


class Kind(IntEnum):
    """What a message is. Requests of cells have 16 to 47, their answers 48 to 63, pushes 64 to 79.

    128 and above belong to contacts.
    """

    HELLO = 1
    WELCOME = 2
    REFUSED = 3
    LOOKUP = 16
    LOOKUP_EACH = 17
    SCAN = 18
    COUNT = 19
    ROWS_OF = 20
    REVISION = 21
    CHANGES = 22
    OBJECTS = 23
    OBJECT = 24
    SIZE = 25
    QUANTILES = 26
    FRESHNESS = 27
    COSTS = 28
    BEGIN = 29
    END = 30
    WATCH = 31
    NOTED = 32
    ROWS = 48
    NUMBERS = 49
    CHANGES_ARE = 50
    OBJECTS_ARE = 51
    HISTOGRAM = 52
    FIGURES = 53
    BEAT = 64
    NEWS = 65


class Refusal(IntEnum):
    """Why a request was not answered.

    USAGE : it cannot be asked for; NO_OBJECT : kept free, since what is not there has an empty
    answer; AWAY : the server's database cannot be reached now; DAMAGED : the environment is
    damaged; TOO_MUCH : over a limit; OUTDATED : the snapshot has ended, or the revision asked for
    is not the newest; BUSY : too many others ask; FAILED : anything else.
    """

    USAGE = 1
    NO_OBJECT = 2
    AWAY = 3
    DAMAGED = 4
    TOO_MUCH = 5
    OUTDATED = 6
    BUSY = 7
    FAILED = 8


class CloseCode(IntEnum):
    """Why the server closed a connection, as the code of WebSocket's close frame."""

    ENDS = 1001
    MALFORMED = 4400
    VERSION = 4426
    IDLE = 4408
    REPLACED = 4410
    FAILED = 4500


class OtherVersionError(ProtocolError):
    """A message of another version of the protocol."""


class MessageHeader(NamedTuple):
    """The first 16 bytes of a message.

    kind : what the message is, a `Kind` where it is known; number : chosen by the client for a
    request and repeated in its answer; revision : of the environment, which an answer was read at.
    """

    kind: int
    number: int = NO_NUMBER
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
