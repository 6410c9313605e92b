"""One server for all tests of a process."""

from collections.abc import Iterator

import pytest

from remote.device_server import DeviceServer


@pytest.fixture(scope="session")
def device_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeviceServer]:
    log = tmp_path_factory.mktemp("server") / "log"
    with DeviceServer(log, snapshot_s=60.0) as server:  # a busy machine may need longer than 5 s
        yield server
    assert "Traceback" not in log.read_text()
