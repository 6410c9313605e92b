"""Leaves that are optimized in entries alone.

numba optimizes each function together with all that it calls, and emits machine code for it. A leaf
five calls below an entry is then optimized six times. In a process that only compiles, nothing but
entries is called from Python. There a leaf is only linked, and the entry's own passes inline it.
"""

from typing import Any

from llvmlite import binding
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

ENVIRONMENT = "_ZN08NumbaEnv"
"""Prefix of the variables through which numba gives functions their constants."""


class _LinkedLibrary(JITCodeLibrary):  # type: ignore[misc]  # numba is untyped
    """Code of a leaf, for its callers alone."""

    _final_module: Any

    def _optimize_final_module(self) -> None:
        """Leave that to the entry."""

    def _finalize_final_module(self) -> None:
        """Keep the code for callers; emit nothing but the variables that numba writes to."""
        self._finalized = True
        self._get_module_for_linking()
        names = [known.name for known in self._final_module.global_variables]
        words = [f'@"{name}" = common global ptr null' for name in names if ENVIRONMENT in name]
        self._final_module = binding.parse_assembly("\n".join(words))
        super()._finalize_final_module()


class LeafCompiler(Compiler):  # type: ignore[misc]  # likewise
    """numba's compiler, for leaves."""

    def __init__(self, typing_context: Any, target: Any, library: Any, *others: Any) -> None:  # noqa: ANN401 - likewise
        if library is None:
            library = _LinkedLibrary(target.codegen(), "leaf")
            library.enable_object_caching()
        super().__init__(typing_context, target, library, *others)
