"""Kernels compiled before the library's first call of them, with a line that says so."""

import os
import sys
from collections.abc import Callable, Collection
from threading import Lock

from hapticdb.kernels.compiling import (
    NAMES,
    Compiled,
    compile_missing,
    entries_for,
    load,
    missing,
)

SECONDS = {"period.loop.move_by_coupling": 6.0}
"""Seconds that the longest kernel compiles, of one processor; the others take `SHORT` each."""
SHORT = 0.7


def seconds_of(names: Collection[str]) -> float:
    """Seconds that entries take to compile on this machine's processors, roughly."""
    each = [SECONDS.get(name, SHORT) for name in names]
    return max(sum(each) / min(os.cpu_count() or 1, len(each)), *each)


def session_purposes(rendering: str, *, reads_distances: bool) -> list[str]:
    """Purposes of a session with that rendering, under a law that reads distances or not."""
    direct = "direct by distance" if reads_distances else "direct"
    return ["feel", "coupling" if rendering == "coupled" else direct]


_READY: set[str] = set()
_COMPILING = Lock()


def make_ready(*purposes: str, progress: Callable[[Compiled], None] | None = None) -> int:
    """Compile what those purposes call and this machine has not compiled yet, side by side.

    purposes : as `hapticdb.kernels.compiling.PURPOSES` names them; progress : as for `warm_up`;
    without it a line on standard error says what is waited for. Returns how many were compiled.
    """
    if _READY.issuperset(purposes):
        return 0
    with _COMPILING:
        names = missing(entries_for(*purposes))
        if names and progress is None:
            kernels = f"{len(names)} kernel{'s' * (len(names) > 1)}"
            sys.stderr.write(
                f"hapticdb: compiling {kernels}, once on this machine: about "
                f"{seconds_of(names):.0f} s ...\n"
            )
            sys.stderr.flush()
        n_compiled = compile_missing(names, progress) if names else 0
        _READY.update(purposes)
        return n_compiled


def warm_up(progress: Callable[[Compiled], None] | None = None) -> None:
    """Compile every kernel that this machine has not compiled yet, and load all of them.

    Half a minute on two processors where nothing is compiled yet, a process for each; about a
    second later. Afterwards no import, touch, session or sweep of this process compiles anything.
    `progress` is called with the numbers of kernels that are compiled and that were missing, at the
    start and after each few; not at all when none was missing.
    """
    compile_missing(NAMES, progress)
    load(NAMES)
