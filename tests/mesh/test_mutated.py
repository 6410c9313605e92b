"""A run of `mutate_files`: damaged files are read, or refused with a one-line error."""

import sys
from pathlib import Path

import pytest

from children import finished
from draws import is_every
from file_seeds import seeds
from hapticdb.mesh import SUFFIXES

SCRIPT = Path(__file__).parent.parent / "mutate_files.py"
FILES = 6000 if is_every() else 600


@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted as Linux counts it")
@pytest.mark.long
def test_mutated_files_read_or_refused() -> None:
    ended = finished([sys.executable, str(SCRIPT), str(FILES)], timeout=1100)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert f"{FILES:,} files" in ended.stdout


def test_seeds_every_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HAPTICDB_TEST_DATA", raising=False)
    assert [suffix for suffix in SUFFIXES if not seeds(suffix, tmp_path)] == []
