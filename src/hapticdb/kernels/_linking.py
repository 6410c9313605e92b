"""How a process that builds a set compiles: each thing once.

There nothing but entries is called from Python. numba would optimize each function together with
all that it calls, and emit machine code for it: a leaf five calls below an entry six times. Instead
an entry links each leaf below it, once, and its own passes inline and optimize them: 50 s of
processor time for all entries instead of 86.
"""

from typing import Any

from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler


class _Library(JITCodeLibrary):  # type: ignore[misc]  # numba is untyped
    """Code of a function."""

    def _optimize_functions(self, module: Any) -> None:  # noqa: ANN401 - numba's
        """Optimize no function alone: an entry's passes do it with all that it calls."""
        module.data_layout = self._codegen._data_layout  # noqa: SLF001


class _LeafLibrary(_Library):
    """Code of a leaf, for entries alone."""

    def finalize(self) -> None:
        """Keep the code for entries."""
        self._finalized = True
        self._get_module_for_linking()


class _EntryLibrary(_Library):
    """Code of an entry, with all leaves below it."""

    _linking_libraries: list[Any]

    def finalize(self) -> None:
        """Link callers before what they call: LLVM leaves out what nothing has called yet."""
        found: dict[Any, None] = {}
        _add_callees(self._linking_libraries, found)
        self._linking_libraries = list(found)[::-1]
        super().finalize()


def _add_callees(libraries: list[Any], found: dict[Any, None]) -> None:
    """Add libraries and those of the leaves below them, each behind all that it calls."""
    for library in libraries:
        if library not in found:
            if isinstance(library, _LeafLibrary):
                _add_callees(library._linking_libraries, found)  # noqa: SLF001
            found[library] = None


class EntryCompiler(Compiler):  # type: ignore[misc]  # likewise
    """numba's compiler, for entries."""

    def __init__(self, typing_context: Any, target: Any, library: Any, *others: Any) -> None:  # noqa: ANN401 - likewise
        library = _EntryLibrary(target.codegen(), "kernel")
        library.enable_object_caching()
        super().__init__(typing_context, target, library, *others)


def link_leaves_into_entries() -> None:
    """Let numba make no machine code but of entries.

    Leaves are all else that it compiles: ours, and its own functions that they call.
    """
    begin = Compiler.__init__

    def __init__(self: Any, typing_context: Any, target: Any, library: Any, *others: Any) -> None:  # noqa: ANN401, N807 - numba's
        if library is None:
            library = _LeafLibrary(target.codegen(), "leaf")
            library.enable_object_caching()
        begin(self, typing_context, target, library, *others)

    Compiler.__init__ = __init__
    JITCPUCodegen.set_env = lambda *_: None  # constants of functions that are called
