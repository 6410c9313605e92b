"""A URL's scheme picks the engine."""

import sys

import pytest

import hapticdb
from hapticdb.errors import MissingExtraError, UsageError


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
