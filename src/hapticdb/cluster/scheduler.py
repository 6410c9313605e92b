"""Work on other machines, by a running scheduler of dask.distributed.

A task is one call that can be pickled and writes nothing. So dask can repeat it after the loss of a
worker, and an interrupted command has the same effect as without a cluster.
"""

import pickle
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from typing import Any, TypeVar

from hapticdb.errors import ClusterError, MissingExtraError, pip_line

Item = TypeVar("Item")
Done = TypeVar("Done")
LONGEST_S = 10.0
"""Seconds until a timeout of the connection, and of a scheduler without workers."""
POLL_EVERY_S = 1.0
"""Seconds between checks for workers."""
AHEAD = 3
"""Tasks submitted in advance for each thread of the workers."""
QUIET = dict.fromkeys(("distributed", "distributed.client"), "critical")
"""Log levels of dask: all messages for a user are errors of ours."""


class Cluster:
    """Workers of a scheduler; made by `connected`."""

    def __init__(self, address: str, client: Any) -> None:  # noqa: ANN401 - dask is an extra
        self.address = address
        self._client = client
        self._version = version("hapticdb")
        self._there = time.monotonic()

    def submit(self, work: Callable[[], object]) -> Any:  # noqa: ANN401 - dask's future
        """Submit a task."""
        # pickled here, so that the scheduler needs no hapticdb, and copies no arrays
        with self._reporting():
            return self._client.submit(_task(), self._version, pickle.dumps(work, 5), pure=False)

    def result(self, task: Any) -> Any:  # noqa: ANN401
        """Wait for a task; return its result or raise its error."""
        from distributed import KilledWorker  # noqa: PLC0415 - an extra

        while True:
            with self._reporting():
                try:
                    error = task.exception(timeout=POLL_EVERY_S)
                    if error is None:
                        found, packed = task.result(timeout=LONGEST_S)
                except TimeoutError:  # not done, or its worker was lost meanwhile
                    self._threads()
                    continue
            if isinstance(error, KilledWorker):
                raise ClusterError(
                    f"{self.address}: a task has ended several workers, one after the other: give "
                    "them more memory"
                )
            if error is not None:
                raise error
            if found != self._version:
                raise ClusterError(
                    f"{self.address}: a worker has {found or 'no'} hapticdb: install "
                    f"{self._version} there, as here"
                )
            return pickle.loads(packed)  # noqa: S301 - of our task

    def each(
        self, work: Callable[[Item], Done], items: Iterable[Item]
    ) -> Generator[Done, None, None]:
        """Yield the results of `work` on items, in order; a few are computed in advance."""
        waiting: deque[Any] = deque()
        try:
            for item in items:
                waiting.append(self.submit(partial(work, item)))
                if len(waiting) > AHEAD * max(self._threads(), 1):
                    yield self.result(waiting.popleft())
            while waiting:
                yield self.result(waiting.popleft())
        finally:
            self.cancel(waiting)

    def cancel(self, tasks: Iterable[Any]) -> None:
        """Cancel tasks that no worker has begun."""
        self._client.cancel([*tasks])

    def _threads(self) -> int:
        with self._reporting():
            try:
                count_threads = self._client.scheduler.ncores
                threads: dict[str, int] = self._client.sync(
                    count_threads, callback_timeout=LONGEST_S
                )
            except TimeoutError as error:  # its process or its machine is suspended
                raise OSError(error) from error
        n_threads = sum(threads.values())
        now = time.monotonic()
        self._there = now if n_threads else self._there
        if now - self._there > LONGEST_S:
            raise ClusterError(
                f"{self.address} has no worker: start some with 'dask worker {self.address}'"
            )
        return n_threads

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Raise ClusterError if the scheduler went away."""
        from distributed import CancelledError  # noqa: PLC0415 - an extra

        try:
            yield
        except (ClusterError, TimeoutError):
            raise
        except (CancelledError, OSError, ValueError) as error:
            raise ClusterError(f"{self.address}: the scheduler went away") from error


@contextmanager
def connected(address: str | None) -> Iterator[Cluster | None]:
    """Connect to a scheduler, ``tcp://host:8786``, for the block; None without an address.

    Raises `MissingExtraError` if dask.distributed is not installed; `ClusterError` if no scheduler
    answers there.
    """
    if address is None:
        yield None
        return
    import asyncio  # noqa: PLC0415 - 15 ms of the start of most verbs

    try:
        import dask  # noqa: PLC0415 - an extra

        dask.config.set({"logging": QUIET})
        from distributed import Client, Security, rpc  # noqa: PLC0415
    except ImportError as error:
        raise MissingExtraError(
            f"work on {address} needs dask.distributed: install it with {pip_line('cluster')}"
        ) from error

    async def greet() -> None:
        known = Security().get_connection_args("client")
        async with rpc(address, connection_args=known) as scheduler:
            await asyncio.wait_for(scheduler.identity(), LONGEST_S)

    try:
        # a client waits for a silent scheduler without a limit; a notebook has its own event loop
        with ThreadPoolExecutor(1) as pool:
            pool.submit(asyncio.run, greet()).result()
        client = Client(address, timeout=LONGEST_S, set_as_default=False)
    except (OSError, TypeError, ValueError) as error:
        raise ClusterError(
            f"no scheduler at {address}: start one with 'dask scheduler', and name it as it says"
        ) from error
    try:
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1TiB"}):
            yield Cluster(address, client)
    finally:
        client.close(timeout=LONGEST_S)


def _task() -> Callable[[str, bytes], tuple[str, bytes]]:
    """Function of a worker, pickled by value, so it also runs without an installed hapticdb."""

    def run(wanted: str, packed: bytes) -> tuple[str, bytes]:
        import pickle  # noqa: PLC0415
        from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415

        try:
            found = version("hapticdb")
        except PackageNotFoundError:
            found = ""
        if found != wanted:
            return found, b""
        return found, pickle.dumps(pickle.loads(packed)(), 5)  # noqa: S301 - of our caller

    return run
