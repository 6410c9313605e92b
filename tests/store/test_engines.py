"""A URL's scheme picks the engine; what only the other engine has is refused."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import hapticdb
from files_in_use import make
from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.store.connect import backup_environment, grant


def test_a_scheme_that_no_engine_has_is_told() -> None:
    for url in ("memory://x", "http://host/x", "://x"):
        with pytest.raises(UsageError, match=r"give a path, sqlite:///path or postgresql://"):
            hapticdb.open(url)


def test_an_engine_whose_driver_is_missing_says_what_brings_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*'psycopg") as e:
        hapticdb.open("postgresql://me:secret@host/plant")
    assert "secret" not in str(e.value)


def test_what_only_the_other_engine_has_is_refused(tmp_path: Path) -> None:
    file = make(tmp_path / "e.db")
    refused: list[tuple[Callable[[], object], str]] = [
        (lambda: grant(file, "anna", "viewer"), "is on SQLite, which has no roles"),
        (lambda: backup_environment("postgresql:///x", file), "is on PostgreSQL, not a file: use"),
        (lambda: backup_environment(file, "postgresql:///x"), "is on PostgreSQL, not a file: give"),
    ]
    for call, words in refused:
        with pytest.raises(UsageError, match=words):
            call()
