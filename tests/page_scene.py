"""An environment of two parts, and its page with one editor at it, without a browser."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import trimesh

import hapticdb
from children import until
from hapticdb.page.connection import MachineFiles, PageConnection, PageRequest, Visitor
from hapticdb.page.page_process import new_server, open_page
from hapticdb.page.site import Site
from hapticdb.page.tabs import TabbedBrowser
from page_person import PagePerson
from recordings import begun
from serving import browser_at


class NoHost:
    """A host, and each session that it begins: it feels nothing, and only records."""

    is_over, lost_frames = False, 0

    def begin(self, *_: object, **__: object) -> Any:  # noqa: ANN401 - in place of a HostedSession
        return NoHost()

    def record(self, path: Path) -> None:
        """Begin a recording, as a session does."""
        begun(path).close()

    def nothing(self, *_: object) -> None: ...

    move = set_coupling = latest = end = nothing


def two_parts(folder: Path) -> Path:
    """Make an environment of a box and a ball, each of a file of its own; returns its path."""
    trimesh.creation.box((0.2, 0.1, 0.05)).export(folder / "box.stl")
    trimesh.creation.icosphere(1, 0.03).apply_translation((0, 0, 0.2)).export(folder / "ball.stl")
    with hapticdb.create(folder / "scene.db", hapticdb.Grid(0.01, (-0.32, -0.32, -0.32), 6)) as env:
        for name in ("box.stl", "ball.stl"):
            assert env.add(folder / name, unit="m").status == "imported"
    return folder / "scene.db"


@contextmanager
def page_of(
    url: Path, *, recordings: Path | None = None, is_direct: bool = False,
    machine: MachineFiles | None = None,
) -> Iterator[tuple[Site, PagePerson, TabbedBrowser]]:  # fmt: skip
    """Open the page of an environment, with one editor at it."""
    server = new_server()
    ours, theirs = socket.socketpair()
    request = PageRequest(
        dict.fromkeys(("viewer", "toucher", "editor"), str(url)), (), 0, 0, "",
        None if recordings is None else str(recordings), is_direct=is_direct,
        machine=machine,
    )  # fmt: skip
    with ExitStack() as ending:
        ending.callback(ours.close)
        ending.callback(server.stop)
        site = Site(server, NoHost(), request, PageConnection(theirs.detach(), ""))  # type: ignore[arg-type]
        ending.callback(site.close)
        open_page(site, lambda _: Visitor("Ada", "editor"))
        connection = ending.enter_context(browser_at(f"127.0.0.1:{server.get_port()}"))
        person = PagePerson(connection)
        until(lambda: (person.look(0.05), bool(site.browsers))[1])
        person.find("Play")
        (browser,) = site.browsers.values()
        assert isinstance(browser, TabbedBrowser)
        yield site, person, browser
