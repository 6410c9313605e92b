"""Lazy modules of kernels, loaded at first use.

numba and its decorators take 0.4 s to load; a listing or a help text does without.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType


class _Later(ModuleType):
    """Kernel module loaded at the first access to an attribute."""

    def __getattr__(self, name: str) -> object:
        value: object = getattr(import_module(self.__name__), name)
        setattr(self, name, value)  # cached for later accesses
        return value


def later_modules(package: str, init_file: str) -> Callable[[str], ModuleType]:
    """Make the ``__getattr__`` of a package of kernels.

    The import system calls it for unloaded modules, in ``from package import module``.

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
