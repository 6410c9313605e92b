"""The page that plays a path: the part's places are those of the path, in order."""

import base64
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard

import hapticdb
from disassembly_scenes import STACK, made
from hapticdb.errors import FileError
from hapticdb.page.animation import animate


def recorded(page: str) -> list[tuple[float, dict[str, Any]]]:
    """Messages with their times, as viser's player reads them."""
    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found is not None
    packed = base64.b64decode(found.group(1))[8:]
    raw = zstandard.ZstdDecompressor().decompressobj().decompress(packed)
    n = int.from_bytes(raw[:8], "little")
    return [(t, one) for t, one in msgspec.msgpack.decode(raw[8 : 8 + n])["messages"]]


def of_node(messages: list[tuple[float, dict[str, Any]]], name: str, kind: str) -> list[Any]:
    return [(t, one) for t, one in messages if one["type"] == kind and one.get("name") == name]


def test_animate_steps_in_order(tmp_path: Path) -> None:
    with hapticdb.open(made(tmp_path, STACK), read_only=True) as env:
        found = hapticdb.disassemble(env, "lid", keep=["pot"], motions=0)
        steps = [step.found for step in found.steps]
        animate(tmp_path / "out.html", env, steps, exclude=found.steps[-1].excluded)
        with pytest.raises(FileError, match="cannot write"):
            animate(tmp_path / "none" / "out.html", env, steps)
    messages = recorded((tmp_path / "out.html").read_text())
    times = [t for t, _ in messages]
    assert times == sorted(times)
    ended = 0.0
    for n, step in enumerate(steps):
        assert step.path is not None
        moved = of_node(messages, f"/part_{n}", "SetPositionMessage")
        places = np.array([one["position"] for _, one in moved])
        start = places[-1] - step.path.poses[-1][:3, 3]
        assert (start > step.shell.points.min(axis=0)).all()
        assert (start < step.shell.points.max(axis=0)).all()
        shown = next(t for t, one in moved if np.allclose(one["position"], start))
        assert shown == 0.0  # the player begins again with it
        begins = next(t for t, _ in moved if t > 0.0)
        assert begins > ended  # not before the step before it
        ended = moved[-1][0]
        hidden = of_node(messages, f"/part_{n}", "SetSceneNodeVisibilityMessage")
        assert hidden[-1][0] > ended
        assert hidden[-1][1]["visible"] is False
    assert {"/standing", "/words_0", "/words_1"} <= {one.get("name") for _, one in messages}
