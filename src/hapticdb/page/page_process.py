"""Page process: viser on the loopback interface, behind the server's relay."""

import contextlib
import io
import socket
import time
import warnings
from collections.abc import Callable

import viser

from hapticdb.page.connection import PageConnection, PageRequest, Visitor
from hapticdb.page.site import Site
from hapticdb.page.tabs import TabbedBrowser
from hapticdb.session.attached import AttachedHost
from hapticdb.session.processes.process import MessageSender, parent_is_gone

POLL_EVERY = 0.2
"""Period of the check for the parent's end, seconds."""


def work(request: PageRequest, sender: MessageSender) -> None:
    """Serve the page until the parent process ends; sends ``ready`` with viser's port."""
    server = new_server()
    connection = PageConnection(request.server, request.secret)
    connection.guard(server)
    try:
        with AttachedHost(socket.socket(fileno=request.host)) as host:
            site = Site(server, host, request, connection)
            open_page(site, connection.visitor)
            sender.send("ready", server.get_port())
            try:
                while not parent_is_gone():
                    time.sleep(POLL_EVERY)
            finally:
                site.close()
    finally:
        stop(server)


def stop(server: viser.ViserServer) -> None:
    """Stop viser without its message on stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def new_server() -> viser.ViserServer:
    """Start viser on a free port of the loopback interface."""
    # a browser may disconnect at any time: no warning for messages in its queue
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a box with its own address
        return viser.ViserServer("127.0.0.1", 0, verbose=False)


def open_page(site: Site, visitor_of: Callable[[int], Visitor]) -> None:
    """Show scene and panels; `visitor_of` raises KeyError after a client's disconnect."""
    server = site.server
    server.gui.set_panel_label(site.title)
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, dark_mode=False, brand_color=(36, 99, 160)
    )
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(320)  # pixels: 29 % of a window of 1,100
    server.scene.world_axes.visible = False

    def connect(client: viser.ClientHandle) -> None:
        try:
            visitor = visitor_of(client.client_id)
        except KeyError:  # disconnected already
            return
        number = site.take_number()
        try:
            browser = TabbedBrowser(site, client, visitor, number)
        except BaseException:
            site.view.contents.leave(client.client_id)
            site.free_number(number)
            raise
        site.browsers[client.client_id] = browser
        if client.client_id not in server.get_clients():  # disconnected meanwhile
            disconnect(client)

    def disconnect(client: viser.ClientHandle) -> None:
        site.workers.submit(site.leave, client.client_id)

    server.on_client_connect(connect)
    server.on_client_disconnect(disconnect)
    site.clock.start()
