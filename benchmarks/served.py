"""A server in a process of its own, for benchmarks: `hapticdb serve` on a free port."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Self

import hapticdb
from hapticdb import GridOptions, ImportOptions

TOKENS = {role: f"a-token-of-the-{role}" for role in ("viewer", "toucher", "editor")}
"""The token of each role."""
START_SECONDS = 120.0
"""Seconds in which the server must say its address: it may compile first."""
END_SECONDS = 40.0
"""Seconds in which it must end; then it is killed."""
CAR = "demo_vintage_car/vintage_car.glb"
"""The real car, below the folder that HAPTICDB_TEST_DATA names."""
EXTENT = 1.6
"""Edge of the grid as a multiple of the model's longest side."""


class ServedProcess:
    """A server of an environment. Also a context manager.

    Parameters
    ----------
    url : str
        The environment.
    folder : Path
        Where its log goes.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.url = url
        self.log = folder / "server.log"
        given = [f"{role}={token}" for role, token in TOKENS.items()]
        tokens = [word for one in given for word in ("--role-token", one)]
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "hapticdb", "serve", url, *tokens],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True,
            )  # fmt: skip
        late = threading.Timer(START_SECONDS, self._process.kill)
        late.start()
        assert self._process.stdout is not None
        address = self._process.stdout.readline().strip()
        late.cancel()
        if not address:
            raise RuntimeError(f"no server began: {self.log.read_text()}")
        self.port = int(address.rstrip("/").rpartition(":")[2])

    @property
    def pid(self) -> int:
        """Process id of the server itself."""
        return self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.communicate(timeout=END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(END_SECONDS)


def car_or_sample(folder: Path, sample: Path, bits: int) -> str:
    """Import the real car, or the sample car where that is not there; the environment's URL."""
    data = os.environ.get("HAPTICDB_TEST_DATA")
    real = Path(data) / CAR if data else None
    model = real if real is not None and real.is_file() else sample
    url = str(folder / f"{model.stem}.db")
    (report,) = hapticdb.import_files(
        url, [model], ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT))
    )
    if report.error is not None:
        raise report.error
    return url
