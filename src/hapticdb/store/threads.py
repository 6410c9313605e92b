"""Ownership of a store by one thread of one process."""

import os
from threading import get_ident

from hapticdb.errors import UsageError

_forked_as = 0
"""Process id in a process forked after this module was loaded; 0 in any other."""


def _note_fork() -> None:
    global _forked_as  # noqa: PLW0603 - one number a process, read in every call
    _forked_as = os.getpid()


os.register_at_fork(after_in_child=_note_fork)


def this_thread() -> int:
    """Identity of the calling thread, different for its copy in a forked process."""
    return get_ident() + _forked_as


def check_thread(owner: int, url: str) -> None:
    """Refuse a call from a thread or process other than the store's own."""
    if get_ident() + _forked_as != owner:  # `this_thread`, without another call in each frame
        raise UsageError(
            f"{url} belongs to the thread that opened it, in its own process: open it here, too"
        )
