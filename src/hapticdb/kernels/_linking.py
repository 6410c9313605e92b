"""Link-time optimization of sets: each leaf is compiled once, and optimized within its entries.

By default numba optimizes each function together with all its callees, and emits machine code for
it: a leaf five calls below an entry is optimized six times. In a process building a set only
entries are called from Python. So an entry links each leaf below it, once, and its own passes
inline and optimize them: 50 s of processor time for all entries instead of 86.
"""

from typing import Any

from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler


class _Library(JITCodeLibrary):  # type: ignore[misc]  # numba is untyped
    """Code of a function, without optimization on its own."""

    def _optimize_functions(self, module: Any) -> None:  # noqa: ANN401 - numba's
        """Skip the passes of one function: an entry's passes cover all its callees."""
        module.data_layout = self._codegen._data_layout  # noqa: SLF001


class _LeafLibrary(_Library):
    """Code of a leaf, for linking into entries."""

    def finalize(self) -> None:
        """Retain the code for linking, without emitting machine code."""
        self._finalized = True
        self._get_module_for_linking()


class _EntryLibrary(_Library):
    """Code of an entry, with all leaves below it."""

    _linking_libraries: list[Any]

    def finalize(self) -> None:
        """Link callers before callees: LLVM drops functions without a caller so far."""
        found: dict[Any, None] = {}
        _add_callees(self._linking_libraries, found)
        self._linking_libraries = list(found)[::-1]
        super().finalize()


def _add_callees(libraries: list[Any], found: dict[Any, None]) -> None:
    """Add libraries and those of the leaves below them in postorder: callees first."""
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
    """Patch numba's compiler in this process to emit machine code of entries only.

    All other functions are compiled as leaves: ours, and numba's own below them.
    """
    begin = Compiler.__init__

    def __init__(self: Any, typing_context: Any, target: Any, library: Any, *others: Any) -> None:  # noqa: ANN401, N807 - numba's
        if library is None:
            library = _LeafLibrary(target.codegen(), "leaf")
            library.enable_object_caching()
        begin(self, typing_context, target, library, *others)

    Compiler.__init__ = __init__
    JITCPUCodegen.set_env = lambda *_: None  # constants of called functions
