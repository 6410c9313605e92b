"""What the header of a run says of the servers."""

from pathlib import Path

import pytest

import servers
from hapticdb.store.postgres.private_server import Binaries


def test_the_header_says_that_the_shards_suite_does_not_run_on_citus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(servers, "FOUND", [Binaries(tmp_path / "bin", 99, 1)])
    assert servers.citus_line().startswith("Citus: not installed; the shards' suite")
    extensions = tmp_path / "share" / "extension"
    extensions.mkdir(parents=True)
    (extensions / "citus.control").touch()
    assert servers.citus_line().startswith("Citus: installed for postgres99; the shards' suite")
