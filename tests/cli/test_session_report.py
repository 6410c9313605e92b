"""What `feel` says of a tool in an object: live, and at the end."""

from types import SimpleNamespace
from typing import Any

import pytest

from hapticdb.cli import session_report

AWAY = SimpleNamespace(database_lost="gone", url="gone.db", first_objects=())
"""Cells whose database does not answer: ids stand in place of names."""


def session(*, is_loose: bool, ids: tuple[int, ...] = ()) -> Any:  # noqa: ANN401 - of a stand-in
    calm = {"database_lost": None, "recording_ended": None, "cells": AWAY}
    return SimpleNamespace(is_loose=is_loose, enclosing_objects=ids, **calm)


def report(**figures: Any) -> Any:  # noqa: ANN401 - of a stand-in
    told = {"inside_frames": 250, "first_inside_frame": 0, "ended_inside": False, "rate": 500.0}
    return SimpleNamespace(**(told | {"enclosing_objects": (3,)} | figures))


def test_notes_inside_object_once_then_free(
    capsys: pytest.CaptureFixture[str],
) -> None:
    notes = session_report.Notes()
    for _ in range(3):
        notes.report_objects(session(is_loose=True, ids=(3,)))
    said = capsys.readouterr().err
    assert said.count("nothing is felt until it is free") == 1
    assert "the tool is inside object 3" in said
    for _ in range(2):
        notes.report_objects(session(is_loose=False, ids=(3,)))
    assert capsys.readouterr().err.count("the tool is free") == 1


def test_notes_inside_object_name_late_or_missing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    notes = session_report.Notes()
    notes.report_objects(session(is_loose=True))
    assert capsys.readouterr().err == ""
    notes.report_objects(session(is_loose=True))
    assert "the tool is inside an object: nothing is felt" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({}, "it began inside object 3: no force for 250 frames (0.5 s)"),
        ({"first_inside_frame": 600}, "from second 1.2 on it was inside object 3: no force"),
        ({"enclosing_objects": ()}, "it began inside an object: no force"),
        ({"ended_inside": True}, "it never came free"),
        ({"ended_inside": False}, "until it was free"),
    ],
)
def test_inside_text_object_duration_and_end(figures: dict[str, Any], said: str) -> None:
    assert said in session_report.inside_text(report(**figures), AWAY)  # type: ignore[arg-type]
