"""The library says once what its first call waits for."""

from collections.abc import Collection

import pytest

from hapticdb import ready


def test_compiling_is_told_in_one_line_and_happens_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    compiled: list[str] = []

    def compile_missing(names: Collection[str]) -> int:
        compiled.extend(names)
        return len(names)

    monkeypatch.setattr(ready, "_READY", set())
    monkeypatch.setattr(ready, "missing", lambda names: [n for n in names if n not in compiled])
    monkeypatch.setattr(ready, "compile_missing", compile_missing)
    for _ in range(2):
        ready.make_ready("shell")
    assert capsys.readouterr().err.count("\n") == 1
    assert "curves.encode_kernel" in compiled
    assert len(compiled) == len(set(compiled))
