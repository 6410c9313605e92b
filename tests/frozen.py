"""Servers that hang: all their processes are stopped, so connections stay and nothing answers."""

import contextlib
import os
import signal
from collections.abc import Iterator

import pytest

from hapticdb.store.postgres.connecting import answering, connection
from hapticdb.store.postgres.private_server import PrivateServer, _children_of


def freeze(server: PrivateServer) -> None:
    """Stop a server and its children; `thaw` lets them go on."""
    pid = server._postmaster()
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)  # first, so that it starts no more children
    for child in _children_of(pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGSTOP)


def thaw(server: PrivateServer) -> None:
    """Let a server go on; does nothing to one that runs."""
    pid = server._postmaster()
    assert pid is not None
    for member in (*_children_of(pid), pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(member, signal.SIGCONT)


@contextlib.contextmanager
def frozen(*servers: PrivateServer) -> Iterator[None]:
    """Stop servers inside."""
    try:
        for server in servers:
            freeze(server)
        yield
    finally:
        for server in servers:
            thaw(server)


@contextlib.contextmanager
def impatient() -> Iterator[None]:
    """Wait for a server that hangs, or is lost, a few seconds only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(answering, "SILENCE_S", 0.5)
        patch.setattr(answering, "ANSWER_S", 2.0)
        patch.setattr(connection, "RECONNECT_SECONDS", 0.5)
        yield
