"""A TCP relay that adds latency to what passes between programs of this machine."""

import asyncio
import contextlib
import multiprocessing
from collections.abc import Iterator
from functools import partial
from multiprocessing.queues import Queue
from pathlib import Path

READY_WITHIN = 30.0
"""Seconds in which the relay's process must tell its port, and end."""


@contextlib.contextmanager
def delayed(socket: Path, seconds: float) -> Iterator[int]:
    """Relay connections to a Unix socket inside the block; gives the relay's port on 127.0.0.1.

    seconds : latency added to a round trip, half of it each way.
    """
    spawn = multiprocessing.get_context("spawn")
    told = spawn.Queue()
    process = spawn.Process(target=_run, args=(socket, seconds, told), daemon=True)
    process.start()
    try:
        yield told.get(timeout=READY_WITHIN)
    finally:
        process.kill()
        process.join(READY_WITHIN)


def _run(socket: Path, seconds: float, told: "Queue[int]") -> None:
    asyncio.run(_relay(socket, 0.5 * seconds, told))


async def _relay(socket: Path, wait: float, told: "Queue[int]") -> None:
    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far_reader, far_writer = await asyncio.open_unix_connection(socket)
        ways = (reader, far_writer), (far_reader, writer)
        await asyncio.gather(*(_carry(*way, wait) for way in ways))

    async with await asyncio.start_server(accept, "127.0.0.1", 0) as server:
        told.put(server.sockets[0].getsockname()[1])
        await server.serve_forever()


async def _carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, wait: float) -> None:
    """Send what comes, each piece `wait` seconds later; nothing stands for the end."""
    data = b"-"
    while data:
        data = await reader.read(65536)
        later = partial(writer.write, data) if data else writer.close
        asyncio.get_running_loop().call_later(wait, later)
