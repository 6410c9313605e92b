"""Kernels compiled, and loaded, before anybody waits for them."""

from collections.abc import Callable

from hapticdb.kernels.compiling import NAMES, Compiled, compile_missing, load


def warm_up(progress: Callable[[Compiled], None] | None = None) -> None:
    """Compile every kernel that this machine has not compiled yet, and load all of them.

    Half a minute on two processors where nothing is compiled yet, a process for each; about a
    second later. Afterwards no import, touch, session or sweep of this process compiles anything.
    `progress` is called with the numbers of kernels that are compiled and that were missing, at the
    start and after each few; not at all when none was missing.
    """
    compile_missing(NAMES, progress)
    load(NAMES)
