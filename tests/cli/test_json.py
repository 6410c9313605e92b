"""Verbs with a result have --json: standard output is JSON alone, whatever else is told."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import inspect
import json
from pathlib import Path

import pytest

from command_line import Run, made, run, scene  # noqa: F401 - fixtures
from hapticdb.cli import VERBS, app
from hapticdb.store import connect


def test_every_verb_with_a_result_has_json() -> None:
    assert {command.callback for command in app.registered_commands} == set(VERBS)
    without = [verb.__name__ for verb in VERBS if "json" not in inspect.signature(verb).parameters]
    # view and serve print no result, and serve logs as JSON by --log-json
    assert without == ["view", "serve", "demo", "sample", "warm"]


def test_grant_names_the_right(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []
    monkeypatch.setattr(connect, "grant", lambda *words: given.append(words))
    url = "postgresql://me:secret@host/plant"
    code, out, err = run("grant", url, "anna", "--as", "editor", "--json")
    assert (code, err, given) == (0, "", [(url, "anna", "editor")])
    found = json.loads(out)
    assert list(found) == ["environment", "role", "right"]
    assert (found["role"], found["right"]) == ("anna", "editor")
    assert "secret" not in out


def test_remove_names_what_is_gone(run: Run, scene: Path) -> None:
    code, out, err = run("remove", scene, "1,3", "--json")
    assert (code, err) == (0, "")
    found = [json.loads(line) for line in out.splitlines()]
    assert [(obj["id"], obj["name"]) for obj in found] == [(1, "box0"), (3, "box2")]
    left = [json.loads(line) for line in run("objects", scene, "--json")[1].splitlines()]
    assert list(left[0]) == list(found[0])
