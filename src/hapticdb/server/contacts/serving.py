"""Contact proxies of a served environment: cells and tools are held while somebody feels them."""

import asyncio
import logging
from pathlib import Path

from starlette.websockets import WebSocket

from hapticdb.errors import HapticDBError
from hapticdb.page.tools import BUILT_IN, POINTS, built_in, inset_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.protocol.header import CloseCode
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.server.access import Role
from hapticdb.server.contacts.endpoint import Contacts, is_admitted, read_wish, refusing
from hapticdb.server.served import Served
from hapticdb.store.base import scene_bounds

LOG = logging.getLogger("hapticdb.server")
FAILED = "this environment cannot be felt by contact proxies now: its operator finds why in the log"
"""Reason of a close frame, 123 bytes at most."""


class ServedContacts:
    """The endpoint of one server; its cells and tools are made for the first client.

    They are freed when the last client has left.
    """

    def __init__(self, served: Served) -> None:
        self._served = served
        self._tool_names = {Path(file).stem for file in served.tools} or {*BUILT_IN}
        self._changing = asyncio.Lock()
        self._contacts: Contacts | None = None
        self._cells: ResidentCells | None = None
        self._n_clients = 0

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one client until it leaves.

        It is accepted at once, and granted its tool when cells and tools are there: that takes
        seconds for the first one, in which pings are answered; a minute where kernels are compiled
        first.
        """
        role_of_headers = self._served.access.role_of_headers
        if not await is_admitted(websocket, role_of_headers, self._n_clients):
            return
        self._n_clients += 1
        try:
            await websocket.accept()
            async with refusing(websocket):
                # read before the wait: uvicorn answers no ping while a message is not taken
                wish = await read_wish(websocket, self._tool_names)
                contacts = await self._opened()
                if contacts is None:
                    await websocket.close(int(CloseCode.FAILED), FAILED)
                else:
                    await contacts.attend(websocket, wish)
        finally:
            self._n_clients -= 1
            await asyncio.shield(self._rest())

    async def _opened(self) -> Contacts | None:
        """What serves clients, made if need be; None if that fails now."""
        async with self._changing:
            if self._contacts is None:
                try:
                    await self._served.preparation.done()
                    await asyncio.to_thread(self._open)
                except HapticDBError:
                    LOG.exception("contact proxies cannot be served")
            return self._contacts

    async def _rest(self) -> None:
        """Free cells and tools if nobody feels them."""
        async with self._changing:
            if not self._n_clients:
                await asyncio.to_thread(self._close)

    def _open(self) -> None:
        served = self._served
        cells = ResidentCells(served.urls[Role.TOUCHER], distances=True)
        try:
            tools = _tools(served.tools, cells)
            self._contacts = Contacts(cells, tools)
        except BaseException:
            cells.close()
            raise
        self._cells = cells

    def _close(self) -> None:
        contacts, self._contacts = self._contacts, None
        cells, self._cells = self._cells, None
        if contacts is not None:
            contacts.close()
        if cells is not None:
            cells.close()


def _tools(files: tuple[str, ...], cells: ResidentCells) -> dict[str, PointShell]:
    """The operator's tools by the names of their files, in their own frames; else two probes."""
    size = cells.grid.voxel_size
    if files:
        inset = inset_of(size, smooth=True)
        return {Path(file).stem: PointShell.from_file(file, POINTS, inset=inset) for file in files}
    bounds = scene_bounds(cells.first_objects)
    diagonal = 0.0 if bounds is None else float(((bounds[1] - bounds[0]) ** 2).sum() ** 0.5)
    return {tool.name: tool.shell for tool in built_in(diagonal, size, smooth=True)}
