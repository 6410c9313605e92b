"""A TCP relay that delays what passes, in a process of its own.

    python benchmarks/delaying.py PORT SECONDS   # SECONDS are added to a round trip

It listens on 127.0.0.1, prints its port, and ends when its standard input closes.
"""

import asyncio
import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial

READY_WITHIN = 30.0
"""Seconds in which a process must print its port, and end when it is asked to."""


@contextlib.contextmanager
def delayed(port: int, seconds: float) -> Iterator[int]:
    """Relay connections to a port of this machine inside the block; gives the relay's port.

    seconds : latency added to a round trip, half of it each way.
    """
    line = [sys.executable, __file__, str(port), repr(seconds)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(line, stdin=pipe, stdout=pipe, text=True)
    try:
        late = threading.Timer(READY_WITHIN, process.kill)
        late.start()
        assert process.stdout is not None
        told = process.stdout.readline()
        late.cancel()
        yield int(told)  # nothing is told by a relay that did not begin
    finally:
        process.kill()
        process.wait(READY_WITHIN)


# -- in the process -------------------------------------------------------------------------------


async def _carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, wait: float) -> None:
    """Send what comes, each piece `wait` seconds later; nothing stands for the end."""
    loop = asyncio.get_running_loop()
    data = b"-"
    while data:
        try:
            data = await reader.read(65536)
        except OSError:
            data = b""
        loop.call_later(wait, partial(writer.write, data) if data else writer.close)


async def relay(port: int, seconds: float) -> None:
    """Relay connections to a port for as long as standard input is open."""

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            writer.close()
            return
        ways = (reader, far_writer), (far_reader, writer)
        await asyncio.gather(*(_carry(*way, 0.5 * seconds) for way in ways))

    async with await asyncio.start_server(accept, "127.0.0.1", 0) as server:
        print(server.sockets[0].getsockname()[1], flush=True)
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(relay(int(sys.argv[1]), float(sys.argv[2])))
