"""Validation of a browser's messages, before they reach the page.

viser's page process trusts its clients: a message may set any attribute of a widget, open a public
tunnel, or upload a large file into memory. So the relay decodes each message, checks the type, size
and range of every field, and forwards its own encoding, never the client's bytes.
"""

from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta

from hapticdb.server.access import Role

FARTHEST = 1e9
"""Greatest absolute value of a coordinate, metres, and of any other number."""
LARGEST = 16 << 10
"""Most bytes of a message; a long text field fits. Larger: more to decode for each."""

Real = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
"""A finite number: msgspec's bounds exclude NaN, too."""
Whole = Annotated[int, Meta(ge=-(10**9), le=10**9)]
Name = Annotated[str, Meta(max_length=512)]
Text = Annotated[str, Meta(max_length=2048)]
Three = tuple[Real, Real, Real]
Four = tuple[Real, Real, Real, Real]
Modifier = Annotated[str, Meta(max_length=64)] | None
Some = Annotated[list[bool | Whole | Real | Text], Meta(max_length=64)]
Value = bool | Whole | Real | Text | Some | None


class _Message(msgspec.Struct, forbid_unknown_fields=True):
    """A message of a browser; viser defines the names of messages and fields."""


class ViewerCameraMessage(_Message, tag=True):
    """Camera of the view."""

    wxyz: Four
    position: Three
    fov: Real
    near: Real
    far: Real
    image_height: Whole
    image_width: Whole
    look_at: Three
    up_direction: Three


class ScenePointerMessage(_Message, tag=True):
    """A click into the scene."""

    event_type: Literal["click"]
    ray_origin: Three
    ray_direction: Three
    screen_pos: Annotated[list[tuple[Real, Real]], Meta(min_length=1, max_length=4)]
    modifier: Modifier = None


class TransformControlsUpdateMessage(_Message, tag=True):
    """Motion of a gizmo."""

    name: Name
    wxyz: Four
    position: Three
    owner: Name = ""


class TransformControlsDragStartMessage(_Message, tag=True):
    """Start of a gizmo's drag."""

    name: Name
    owner: Name = ""


class TransformControlsDragEndMessage(TransformControlsDragStartMessage, tag=True):
    """End of a gizmo's drag."""


class _ValueUpdate(msgspec.Struct, forbid_unknown_fields=True):
    """The only attribute of a widget with browser access."""

    value: Value


class GuiUpdateMessage(_Message, tag=True):
    """New value of a widget."""

    uuid: Name
    updates: _ValueUpdate


class _Tag(msgspec.Struct):
    """Type of any message."""

    type: str


Known = (
    ViewerCameraMessage
    | ScenePointerMessage
    | TransformControlsUpdateMessage
    | TransformControlsDragStartMessage
    | TransformControlsDragEndMessage
    | GuiUpdateMessage
)
FOR_HANDS = (
    TransformControlsUpdateMessage,
    TransformControlsDragStartMessage,
    TransformControlsDragEndMessage,
)
"""Messages of a dragged tool; not for viewers."""

_decoder = msgspec.msgpack.Decoder(Known)
_tag_decoder = msgspec.msgpack.Decoder(_Tag)
_encoder = msgspec.msgpack.Encoder()

Reason = Literal["malformed", "type", "role", "size"]


class Verdict(NamedTuple):
    """Verdict on a message: the bytes for the page, or the reason of a refusal.

    ``malformed``: not from viser's client; ``type``: unused by our page; ``role``: not allowed for
    the browser's role; ``size``: above `LARGEST`.
    """

    passed: bytes | None
    reason: Reason | Literal[""] = ""


def validated(message: bytes, role: Role) -> Verdict:
    """Decode a browser's message, and encode it anew if it may pass."""
    if len(message) > LARGEST:
        return Verdict(None, "size")
    try:
        decoded = _decoder.decode(message)
    except msgspec.ValidationError:
        return Verdict(None, "malformed" if _is_known(message) else "type")
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return Verdict(None, "malformed")
    if role < Role.TOUCHER and isinstance(decoded, FOR_HANDS):
        return Verdict(None, "role")
    return Verdict(_encoder.encode(decoded))


def _is_known(message: bytes) -> bool:
    """Whether a message with invalid fields has a type of ours, or none."""
    try:
        tag = _tag_decoder.decode(message).type
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return True
    return tag in TYPES


TYPES = frozenset(kind.__name__ for kind in Known.__args__)
"""Names of the accepted types."""
