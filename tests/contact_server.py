"""A server for remote hands in a process of its own: python contact_server.py URL TOOL.

The tool is a saved shell, so nothing is sampled here. The port is printed when the server is ready.
It ends when its standard input closes, and then prints the number of proxies and the seconds spent
on them. Options: --idle=SECONDS after which a client that sends nothing is dropped, --port=N.
"""

import argparse
import asyncio
import sys
import threading
import time

from hapticdb.hosting.contact_source import ContactSource
from hapticdb.protocol.contacts import HandState
from hapticdb.server import contacts
from hapticdb.server.access import Role
from hapticdb.server.running import run
from hapticdb.server.served import Serving
from serving import urls

TOKEN = "a-token-for-tests-only"  # noqa: S105 - of no use elsewhere


async def serve(serving: Serving) -> None:
    """Serve until standard input closes."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()

    def wait_for_end() -> None:
        sys.stdin.read()
        loop.call_soon_threadsafe(stop.set)

    def ready(port: int) -> None:
        sys.stdout.write(f"{port}\n")
        sys.stdout.flush()
        threading.Thread(target=wait_for_end, daemon=True).start()

    await run(serving, ready, stop)


def main() -> None:
    """Serve what the command line names."""
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("tool")
    parser.add_argument("--idle", type=float, default=contacts.IDLE_AFTER)
    parser.add_argument("--port", type=int, default=0)
    given = parser.parse_args()
    contacts.IDLE_AFTER = given.idle
    compute, spent = contacts._proxy, list[float]()

    def timed(source: ContactSource, hand: HandState, arrived: float) -> bytes:
        began = time.perf_counter()
        message = compute(source, hand, arrived)
        spent.append(time.perf_counter() - began)
        return message

    contacts._proxy = timed
    serving = Serving(
        urls(given.url), (given.tool,), {TOKEN: Role.TOUCHER}, port=given.port,
        page="viser_page:work",
    )  # fmt: skip
    asyncio.run(serve(serving))
    sys.stderr.write(f"{len(spent)} {sum(spent)}\n")


if __name__ == "__main__":
    main()
