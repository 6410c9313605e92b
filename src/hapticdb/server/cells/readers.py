"""A limited number of opened stores and threads, in which the event loop has statements run."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from hapticdb.errors import ConnectionLostError, DatabaseError, HapticDBError
from hapticdb.server.cells.answers import RequestRefusedError
from hapticdb.store.base import Store
from hapticdb.store.connect import open_store
from hapticdb.store.threads import NOBODY, this_thread

Result = TypeVar("Result")


class Readers:
    """Stores of one environment, opened to read when they are needed.

    Parameters
    ----------
    url : str
        The environment.
    threads : int
        Statements that run at once.
    snapshots : int
        Stores beyond that, for snapshots that are held while no statement runs.
    """

    def __init__(self, url: str, *, threads: int, snapshots: int) -> None:
        self._url = url
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="cells")
        self._free: list[Store] = []
        self._room = asyncio.Semaphore(threads)
        self._room_held = asyncio.Semaphore(snapshots)
        self._is_closed = False
        self.identity: object = None

    async def run(self, store: Store, work: Callable[[Store], Result]) -> Result:
        """Run statements of a store that the caller has taken, in a thread."""

        def owned() -> Result:
            store.give_to(this_thread())
            try:
                return work(store)
            finally:
                store.give_to(NOBODY)

        running = asyncio.get_running_loop().run_in_executor(self._threads, owned)
        try:
            return await asyncio.shield(running)
        except asyncio.CancelledError:  # the statement goes on, so the store is not free yet
            await asyncio.wait({running})
            raise

    @contextlib.asynccontextmanager
    async def lent(self, *, anew: bool = False) -> AsyncIterator[Store]:
        """Lend a store for one piece of work; waits for a free one. `anew`: opened just now."""
        async with self._room:
            if anew and self._free:
                await self._closed(self._free.pop())
            store = await (self._opened_anew() if anew else self._taken())
            is_sound = False
            try:
                yield store
                is_sound = True
            except ConnectionLostError:
                is_sound = not self.is_outdated(store)  # it connects again by itself
                raise
            except RequestRefusedError:
                is_sound = True  # the request was at fault
                raise
            finally:
                await self._take_back(store, is_sound=is_sound)

    async def hold(self, seconds: float) -> Store | None:
        """Take a store for a snapshot; None if there is none in that time. `give_back` follows."""
        try:
            await asyncio.wait_for(self._room_held.acquire(), seconds)
        except TimeoutError:
            return None
        try:
            return await self._taken()
        except BaseException:
            self._room_held.release()
            raise

    async def give_back(self, store: Store, *, is_sound: bool) -> None:
        """Give a store back that `hold` has taken; its snapshot has ended."""
        try:
            await self._take_back(store, is_sound=is_sound)
        finally:
            self._room_held.release()

    def is_outdated(self, store: Store) -> bool:
        """Whether another environment has taken the place of the one that a store has open."""
        return self.identity is not None and store.identity != self.identity

    async def _taken(self) -> Store:
        while self._free:
            store = self._free.pop()
            if not self.is_outdated(store):
                return store
            await self._closed(store)
        return await self._opened_anew()

    async def _opened_anew(self) -> Store:
        store = await asyncio.get_running_loop().run_in_executor(self._threads, self._opened)
        if self.identity is None:
            self.identity = store.identity
        return store

    def _opened(self) -> Store:
        store = open_store(self._url, read_only=True)
        store.give_to(NOBODY)
        return store

    async def _take_back(self, store: Store, *, is_sound: bool) -> None:
        if is_sound and not self._is_closed and not self.is_outdated(store):
            self._free.append(store)
        else:
            await self._closed(store)

    async def _closed(self, store: Store) -> None:
        with contextlib.suppress(HapticDBError, OSError, RuntimeError):
            await self.run(store, lambda one: one.close())

    async def close(self) -> None:
        """Close all free stores, and end the threads; stores in use are closed when they return."""
        self._is_closed = True
        while self._free:
            await self._closed(self._free.pop())
        self._threads.shutdown(wait=False)


def is_away(error: BaseException) -> bool:
    """Whether an error says that the database cannot be reached, and not that it refuses."""
    return isinstance(error, (ConnectionLostError, OSError)) or (
        isinstance(error, DatabaseError) and isinstance(error, TimeoutError)
    )
