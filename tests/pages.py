"""The page in this process, without a server, and with sessions that only record."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import trimesh
from websockets.sync.client import connect

import hapticdb
from children import PATIENCE, until
from hapticdb.page.connection import PageConnection, PageRequest, Visitor, line
from hapticdb.page.process import new_server, open_page
from hapticdb.page.site import Site
from hapticdb.page.tabs import TabbedBrowser
from hapticdb.recording.file import Recorder
from page_person import PagePerson
from recordings import HEADER
from serving import PROTOCOL


class OnlyRecords:
    """A session that feels nothing."""

    is_over, lost_frames = False, 0

    def move(self, pose: object) -> None:
        pass

    def set_coupling(self, coupling: object) -> None:
        pass

    def latest(self) -> None:
        return None

    def record(self, path: Path) -> None:
        """Begin a recording, as a session does."""
        Recorder(path, HEADER).close()

    def stop_recording(self) -> int:
        return 0

    def end(self) -> None:
        pass


class NoHost:
    """Begins sessions that feel nothing."""

    def begin(self, *_: object, **__: object) -> Any:  # noqa: ANN401 - in place of a HostedSession
        return OnlyRecords()


def two_parts(folder: Path) -> Path:
    """Make an environment of a box and a ball, each of a file of its own; returns its path."""
    trimesh.creation.box((0.2, 0.1, 0.05)).export(folder / "box.stl")
    ball = trimesh.creation.icosphere(1, 0.03)
    ball.apply_translation((0.0, 0.0, 0.2))
    ball.export(folder / "ball.stl")
    grid = hapticdb.Grid(0.01, (-0.32, -0.32, -0.32), 6)
    with hapticdb.create(folder / "scene.db", grid) as env:
        for name in ("box.stl", "ball.stl"):
            assert env.add(folder / name, unit="m").status == "imported"
    return folder / "scene.db"


@contextmanager
def page_of(
    url: Path, *, folders: tuple[str, ...] | None = None, recordings: Path | None = None
) -> Iterator[tuple[Site, PagePerson, TabbedBrowser]]:
    """Open the page of an environment, with one editor at it."""
    server = new_server()
    ours, theirs = socket.socketpair()
    ours.sendall(line({"word": "prepared"}))
    request = PageRequest(
        dict.fromkeys(("viewer", "toucher", "editor"), str(url)), (), folders, 0, 0,
        None if recordings is None else str(recordings),
    )  # fmt: skip
    try:
        site = Site(server, NoHost(), request, PageConnection(theirs.detach()))  # type: ignore[arg-type]
        try:
            open_page(site, lambda _: Visitor("Ada", "editor"))
            address = f"ws://127.0.0.1:{server.get_port()}"
            with connect(
                address, subprotocols=PROTOCOL, compression=None, proxy=None, open_timeout=PATIENCE,
                max_size=None,
            ) as connection:  # fmt: skip
                person = PagePerson(connection)
                until(lambda: (person.look(0.05), bool(site.browsers))[1])
                person.find("Play")
                (browser,) = site.browsers.values()
                assert isinstance(browser, TabbedBrowser)
                yield site, person, browser
        finally:
            site.close()
    finally:
        server.stop()
        ours.close()
