"""Supervisor of the page process: start, restart after its death, messages."""

import asyncio
import contextlib
import logging
import secrets
import socket
from collections.abc import Callable

from hapticdb.errors import HapticDBError
from hapticdb.page.connection import NAME, PING, PONG, REFUSED, ROLE, SECRET, SHOWN
from hapticdb.session.processes.process import Process

LOG = logging.getLogger("hapticdb.server")
START_TIMEOUT = 120.0
"""Time limit of a page's start, seconds; it reads and prepares the whole scene."""
ANSWER_TIMEOUT = 2.0
"""Time limit of a page's pong, seconds. Larger: a hang is noticed later."""
FIRST_PAUSE = 0.5
"""Seconds before a dead page is restarted; doubled at each further death."""
LONGEST_PAUSE = 30.0
"""Greatest such pause."""


class PageSupervisor:
    """Runs a page process, and restarts it when it ends.

    work : function of the process, as of `Process`; it sends ``ready`` with its port.
    request : makes the request of a process from its sockets to the server and to the host, and
    from the secret of the server's connections.
    serve_host : receives the host's end of the socket for the page's sessions.
    """

    def __init__(
        self,
        work: str,
        request: Callable[[int, int, str], object],
        serve_host: Callable[[socket.socket], None],
    ) -> None:
        self._work, self._request, self._serve_host = work, request, serve_host
        self._process: Process | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._reader: asyncio.StreamReader | None = None
        self._secret = ""
        self._has_answered = asyncio.Event()
        self._is_stopping = False
        self.port = 0
        self.n_starts = 0

    @property
    def is_ready(self) -> bool:
        """Whether browsers can connect now."""
        return self._process is not None and self._process.is_alive and self.port != 0

    @property
    def pid(self) -> int:
        """Process id of the page; 0 if it does not run."""
        return self._process.pid if self._process is not None else 0

    async def start(self) -> None:
        """Start a page process and wait until it is ready.

        Raises `HapticDBError` from a failed start of the page, or at the time limit; `OSError` if
        the machine has no room for another process or its sockets.
        """
        process, ours, host_ours = await self._begun()
        self._process = process  # `stop` can end it from now on
        self._serve_host(host_ours)
        try:
            self.port = await asyncio.to_thread(_port_of, process)
        except BaseException:
            ours.close()
            self._process = None
            await asyncio.to_thread(process.end)
            raise
        self._reader, self._writer = await asyncio.open_connection(sock=ours)
        self.n_starts += 1
        LOG.info("the page is ready", extra={"pid": process.pid})

    async def _begun(self) -> tuple[Process, socket.socket, socket.socket]:
        """Start a page process; returns it, and our ends of its sockets to us and to the host."""
        with contextlib.ExitStack() as ours:
            pairs = []
            with contextlib.ExitStack() as theirs:
                for _ in range(2):
                    own, other = socket.socketpair()
                    pairs.append((ours.enter_context(own), theirs.enter_context(other)))
                server, host = (other.fileno() for _, other in pairs)
                self._secret = secrets.token_urlsafe()
                request = self._request(server, host, self._secret)
                process = await asyncio.to_thread(Process, self._work, request, (server, host))
            ours.pop_all()  # nothing failed, so they stay open
        return process, pairs[0][0], pairs[1][0]

    async def supervise(self) -> None:
        """Receive the page's messages, and restart it whenever it ends; until `stop`."""
        loop = asyncio.get_running_loop()
        pause = FIRST_PAUSE
        while True:
            began = loop.time()
            await self._listen()
            if self._is_stopping:
                return
            await self._end()
            if loop.time() - began > 60.0:
                pause = FIRST_PAUSE
            LOG.error("the page process ended; it is started again in %.3g s", pause)
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)
            try:
                await self.start()
            except (HapticDBError, OSError) as error:
                LOG.error("the page cannot start: %s", error)  # noqa: TRY400 - its message says all

    def headers(self, name: str, role: str, shown: str) -> dict[str, str]:
        """Headers for a browser's connection: name, role, ids of shown parts, and the secret."""
        return {SECRET: self._secret, NAME: name, ROLE: role, SHOWN: shown}

    async def answers(self) -> bool:
        """Whether the page responds now, within `ANSWER_TIMEOUT`."""
        if not self.is_ready or self._writer is None:
            return False
        self._has_answered.clear()
        self._writer.write(PING)
        try:
            await asyncio.wait_for(self._has_answered.wait(), ANSWER_TIMEOUT)
        except TimeoutError:
            return False
        return self.is_ready

    async def stop(self) -> None:
        """End the page process, after its sessions."""
        self._is_stopping = True
        await self._end()

    async def _listen(self) -> None:
        """Receive the page's messages until it ends."""
        reader = self._reader
        if reader is None:
            return
        with contextlib.suppress(OSError, ValueError):
            while received := await reader.readline():
                if received == PONG:
                    self._has_answered.set()
                elif received == REFUSED:
                    LOG.warning("a connection to the page went round the server: closed")

    async def _end(self) -> None:
        self.port = 0
        process, writer = self._process, self._writer
        self._process = self._reader = self._writer = None
        if process is not None:
            await asyncio.to_thread(process.end)
        if writer is not None:
            writer.close()


def _port_of(process: Process) -> int:
    """Port of a page process, once it is ready."""
    message = process.receive(START_TIMEOUT)
    if message is None:
        raise HapticDBError("the page process ended before it was ready")
    return int(message.content)
