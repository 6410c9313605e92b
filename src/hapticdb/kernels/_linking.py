"""How a process that only compiles does so: each thing once.

There nothing but entries is called from Python. numba would optimize each function together with
all that it calls, and emit machine code for it: a leaf five calls below an entry six times. Instead
an entry links each leaf below it, once, and its own passes inline and optimize them. Most of the
time is numba's own, before LLVM begins; what it notes there for nobody is left out, too.
"""

from contextlib import nullcontext
from functools import cache
from inspect import iscode
from typing import Any

from numba.core import event, transforms
from numba.core.base import BaseContext
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import PassManager, _pass_registry
from numba.core.cpu import CPUContext
from numba.core.postproc import PostProcessor, VariableLifetime
from numba.core.typed_passes import NopythonRewrites
from numba.core.types.functions import BaseFunction
from numba.core.typing import Context
from numba.core.untyped_passes import InlineClosureLikes


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


def compile_once() -> None:
    """Let numba make no machine code but of entries, and search for what a call means once.

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
    search, known = BaseFunction.get_call_type, {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:  # noqa: ANN401
        asked = self, tuple(args), tuple(kws.items())
        if asked not in known:
            known[asked] = search(self, context, args, kws)
        return known[asked]

    BaseFunction.get_call_type = get_call_type  # type: ignore[method-assign]


def ask_once() -> None:
    """Let numba load its registries once, and not for each function, and ask for a size once."""
    for kind in CPUContext, Context:
        kind.load_additional_registries = cache(kind.load_additional_registries)
    for size in "get_abi_sizeof", "get_abi_alignment":
        setattr(BaseContext, size, cache(getattr(BaseContext, size)))


def note_nothing() -> None:
    """Let numba tell no listeners, take no times, and compute no lives of variables in between.

    Nor does it rewrite array expressions, which no kernel has, or search for closures where the
    Python code has none. A fifth of the time of compiling; what is compiled stays the same.
    """
    event.start_event = event.end_event = lambda *_, **__: None
    event.trigger_event = lambda *_, **__: nullcontext()

    def run_pass(self: Any, _: int, done: Any, state: Any) -> None:  # noqa: ANN401
        constants = state.func_id.code.co_consts
        if isinstance(done, NopythonRewrites) or (
            isinstance(done, InlineClosureLikes) and not any(map(iscode, constants))
        ):
            return
        done.analysis = self._analysis
        has_changed = done.run_initialization(state)
        has_changed |= done.run_pass(state)
        has_changed |= done.run_finalizer(state)
        if _pass_registry.get(type(done)).mutates_CFG:
            if has_changed:
                PostProcessor(state.func_ir).run()
            else:
                state.func_ir.blocks = transforms.canonicalize_cfg(state.func_ir.blocks)

    PassManager._runPass = run_pass  # noqa: SLF001
    complete = PostProcessor.run

    def run(self: Any, emit_dels: bool = False, *others: Any, **named: Any) -> None:  # noqa: ANN401
        code = self.func_ir
        if emit_dels or code.is_generator:
            complete(self, emit_dels, *others, **named)
            return
        code.blocks = transforms.canonicalize_cfg(code.blocks)
        code.variable_lifetime = VariableLifetime(code.blocks)
        code.generator_info = None

    PostProcessor.run = run
