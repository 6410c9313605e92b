"""Modules of kernels that are loaded when something in them is first used.

numba and its decorators take 0.4 s to load, which a listing or a help text need not wait for.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType


class _Later(ModuleType):
    """A kernel module that is loaded when something in it is first used."""

    def __getattr__(self, name: str) -> object:
        value: object = getattr(import_module(self.__name__), name)
        setattr(self, name, value)  # found here from now on
        return value


def later_modules(package: str, init_file: str) -> Callable[[str], ModuleType]:
    """Make the ``__getattr__`` of a package of kernels.

    The import system asks it for modules that are not loaded yet, as ``from package import module``
    does.

    Parameters
    ----------
    package, init_file : str
        ``__name__`` and ``__file__`` of the package.
    """
    names = frozenset(path.stem for path in Path(init_file).parent.glob("[a-z]*.py"))

    def load_later(name: str) -> ModuleType:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return _Later(f"{package}.{name}")

    return load_later
