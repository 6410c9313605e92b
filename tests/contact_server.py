"""A server of contact proxies in a process of its own: python contact_server.py URL NAME=SHELL ...

A shell is a .npz of points and normals, so that no tool is sampled here. The port is printed when
the server is ready. It ends when its standard input closes. Options: --idle=SECONDS after which a
client that sends nothing is dropped, --port=N.
"""

import argparse
import asyncio
import socket
import sys
import threading
import time
from pathlib import Path

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket

from hapticdb.hosting.contact_source import ContactSource
from hapticdb.pointshell.shell import PointShell
from hapticdb.protocol.contacts import HandState
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.server.access import Access, Role
from hapticdb.server.contacts import endpoint
from hapticdb.server.contacts.endpoint import IDLE_AFTER, Contacts, is_admitted

TOKEN = "a-token-for-tests-only"  # noqa: S105 - of no use elsewhere


def save_shell(path: Path, shell: PointShell) -> None:
    """Write a shell for a server."""
    np.savez(path, points=shell.points, normals=shell.normals, center=shell.center)


def load_shell(path: str) -> PointShell:
    """Read what `save_shell` has written."""
    with np.load(path) as stored:
        return PointShell(stored["points"], stored["normals"], stored["center"], is_closed=False)


async def serve(
    url: str, tools: dict[str, PointShell], *, idle: float = IDLE_AFTER, port: int = 0
) -> None:
    """Serve until standard input closes."""
    compute, spent = endpoint._proxy, list[float]()

    def timed(source: ContactSource, hand: HandState, arrived: float) -> bytes:
        began = time.perf_counter()
        message = compute(source, hand, arrived)
        spent.append(time.perf_counter() - began)
        return message

    endpoint._proxy = timed
    with ResidentCells(url, budget_bytes=64 << 20, distances=True) as cells:
        contacts = Contacts(cells, tools, idle_after=idle)
        role_of_headers = Access({TOKEN: Role.TOUCHER}).role_of_headers

        async def attend(websocket: WebSocket) -> None:
            if await is_admitted(websocket, role_of_headers, contacts.n_clients):
                await websocket.accept()
                await contacts.attend(websocket)

        config = uvicorn.Config(
            Starlette(routes=[WebSocketRoute("/device/contacts", attend)]),
            ws="websockets-sansio", ws_max_size=4096, ws_per_message_deflate=False,
            log_level="warning", lifespan="off",
        )  # fmt: skip
        server = uvicorn.Server(config)
        with socket.create_server(("127.0.0.1", port)) as listening:
            loop = asyncio.get_running_loop()

            def wait_for_end() -> None:
                sys.stdin.read()
                loop.call_soon_threadsafe(setattr, server, "should_exit", True)

            threading.Thread(target=wait_for_end, daemon=True).start()
            sys.stdout.write(f"{listening.getsockname()[1]}\n")
            sys.stdout.flush()
            await server.serve(sockets=[listening])
        contacts.close()
        sys.stderr.write(f"{len(spent)} {sum(spent)}\n")


def main() -> None:
    """Serve what the command line names."""
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("tools", nargs="+")
    parser.add_argument("--idle", type=float, default=IDLE_AFTER)
    parser.add_argument("--port", type=int, default=0)
    given = parser.parse_args()
    tools = dict(tool.split("=") for tool in given.tools)
    shells = {name: load_shell(path) for name, path in tools.items()}
    asyncio.run(serve(given.url, shells, idle=given.idle, port=given.port))


if __name__ == "__main__":
    main()
