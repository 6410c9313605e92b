"""A small page for tests of the server: a viser server with one slider and one gizmo."""

import threading
import time

import viser

from hapticdb.page.connection import PageConnection, PageRequest
from hapticdb.session.processes.process import MessageSender, parent_is_gone


def work(request: PageRequest, sender: MessageSender) -> None:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    connection = PageConnection(request.server, request.secret)
    connection.guard(server)
    slider = server.gui.add_slider("slider", 0.0, 1.0, 0.1, 0.5)
    said = server.gui.add_markdown("nothing yet")
    server.gui.add_tab_group()
    clock = server.scene.add_label("/clock", "0")
    gizmo = server.scene.add_transform_controls("/gizmo")

    @slider.on_update
    def _(_: object) -> None:
        said.content = f"slider {slider.value}"

    @gizmo.on_update
    def _(_: object) -> None:
        said.content = f"gizmo {gizmo.position[0]:.3f}"

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        who = connection.visitor(client.client_id)
        client.gui.add_markdown(f"{who.name} is a {who.role} {who.shown}")

    sender.send("ready", server.get_port())
    number = 0
    while not parent_is_gone():
        number += 1
        clock.text = str(number)
        time.sleep(0.02)
    server.stop()
    threading.Event().wait(0.01)


def fail(_request: PageRequest, _sender: MessageSender) -> None:
    raise OSError("no such scene")
