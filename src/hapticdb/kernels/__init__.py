"""Kernels: arrays in, arrays out, compiled by numba.

``from hapticdb.kernels import curves`` gives a module that is loaded when something in it is first
used: numba and its decorators take 0.4 s, which a listing or a help text need not wait for. Kernels
themselves import one another by name, at once.
"""

from importlib import import_module
from pathlib import Path
from types import ModuleType

_NAMES = frozenset(path.stem for path in Path(__file__).parent.glob("[a-z]*.py"))


class _Later(ModuleType):
    """A kernel module that is loaded when something in it is first used."""

    def __getattr__(self, name: str) -> object:
        value: object = getattr(import_module(self.__name__), name)
        setattr(self, name, value)  # found here from now on
        return value


def __getattr__(name: str) -> ModuleType:
    """Give a kernel module that is not loaded yet; the import system asks for it."""
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _Later(f"{__name__}.{name}")
