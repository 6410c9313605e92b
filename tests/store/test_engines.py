"""A URL's scheme picks the engine."""

import sys

import pytest

import hapticdb
from hapticdb.errors import MissingExtraError, UsageError


def test_open_unknown_scheme() -> None:
    for url in ("memory://x", "http://host/x", "://x"):
        with pytest.raises(UsageError, match=r"give a path, sqlite:///path or postgresql://"):
            hapticdb.open(url)


def test_open_missing_driver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*'psycopg") as e:
        hapticdb.open("postgresql://me:secret@host/plant")
    assert "secret" not in str(e.value)
