"""Of a browser's messages only what our page uses passes, checked and encoded anew."""

from dataclasses import fields
from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from viser import _messages as viser_messages

from hapticdb.server.access import Role
from hapticdb.server.messages import LARGEST, Known, Verdict, validated
from serving import CAMERA

encode = msgspec.msgpack.encode
GIZMO = {
    "type": "TransformControlsUpdateMessage",
    "name": "/tool",
    "wxyz": [1, 0, 0, 0],
    "position": [0.5, 0, 0],
    "owner": "3",
}
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0, 0, 1],
    "ray_direction": [0, 0, -1],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}


@pytest.mark.parametrize("message", [CAMERA, GIZMO, CLICK])
def test_validated_viser_messages_unchanged(message: dict[str, object]) -> None:
    passed = validated(encode(message), Role.EDITOR).passed
    assert passed is not None
    assert message.items() <= msgspec.msgpack.decode(passed).items()


@pytest.mark.parametrize("kind", get_args(Known))
def test_known_messages_exist_in_viser(kind: type[msgspec.Struct]) -> None:
    theirs = getattr(viser_messages, kind.__name__)
    assert set(kind.__struct_fields__) <= {field.name for field in fields(theirs)}


@pytest.mark.parametrize("content", [True, 0.5, "word", [1, 2.5], ["a", "b"], None])
def test_validated_widget_values(content: object) -> None:
    message = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": content}}
    passed = validated(encode(message), Role.VIEWER).passed
    assert passed is not None
    assert msgspec.msgpack.decode(passed)["updates"] == {"value": content}


@pytest.mark.parametrize(
    "type_", ["ShareUrlRequest", "FileTransferStartUpload", "RunJavascriptMessage", "no such type"]
)
def test_validated_unknown_types(type_: str) -> None:
    for more in ({}, {"uuid": "a"}, {"name": "/tool", "updates": {"visible": False}}):
        assert validated(encode({"type": type_} | more), Role.EDITOR) == Verdict(None, "type")


@pytest.mark.parametrize(
    "updates",
    [
        {},
        {"visible": False},
        {"value": 1, "disabled": True},
        {"value": {"a": 1}},
        {"value": [[1]]},
        {"value": "x" * 2049},
        {"value": [0] * 65},
        {"value": [float("inf")]},
        {"value": float("nan")},
        {"value": [0.0, float("nan")]},
        {"value": 1e12},
        {"value": b"bytes"},
    ],
)
def test_validated_other_attributes_and_values(updates: dict[str, object]) -> None:
    message = {"type": "GuiUpdateMessage", "uuid": "a", "updates": updates}
    assert validated(encode(message), Role.EDITOR) == Verdict(None, "malformed")


@pytest.mark.parametrize(
    "message",
    [
        GIZMO | {"position": [0, 0]},
        GIZMO | {"position": ["0", 0, 0]},
        GIZMO | {"position": [float("nan"), 0, 0]},
        CLICK | {"screen_pos": [[0.5, float("nan")]]},
        CAMERA | {"fov": float("nan")},
        GIZMO | {"name": "x" * 513},
        GIZMO | {"more": 1},
        CLICK | {"ray_origin": None},
        CLICK | {"screen_pos": [[0, 0]] * 5},
        CLICK | {"event_type": "rect-select", "screen_pos": [[0, 0], [1, 1]]},
    ],
)
def test_validated_gizmo_and_click_fields(message: dict[str, object]) -> None:
    assert validated(encode(message), Role.EDITOR) == Verdict(None, "malformed")


def test_validated_gizmo_by_role() -> None:
    assert validated(encode(GIZMO), Role.VIEWER) == Verdict(None, "role")
    assert validated(encode(GIZMO), Role.TOUCHER).passed is not None


def test_validated_size_limit() -> None:
    assert validated(b"\x91" * (LARGEST + 1), Role.EDITOR) == Verdict(None, "size")


@given(st.binary(max_size=300))
def test_validated_arbitrary_bytes(message: bytes) -> None:
    assert validated(message, Role.EDITOR).passed is None or msgspec.msgpack.decode(message)


@given(st.data())
def test_validated_damaged_messages(data: st.DataObject) -> None:
    message = bytearray(encode(data.draw(st.sampled_from([CAMERA, GIZMO]))))
    for _ in range(3):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    passed = validated(bytes(message), Role.EDITOR).passed
    assert passed is None or msgspec.msgpack.decode(passed)["type"]
