"""How kernels are compiled: the numba options of this package, here and nowhere else.

An entry is called from Python and declares the types of its arguments, so that `compiling` can
compile it before its first call, in another process. A leaf is called by kernels only.

Machine code goes into a folder of its own (`_cache`); users' own kernels keep the folder that they
configured.
"""

import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numba
from numba import config, types
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys
from numba.core.sigutils import normalize_signature
from numba.extending import overload
from numba.np.numpy_support import from_dtype

from hapticdb.kernels._cache import CACHE_FOLDER, IN_WORKER
from hapticdb.kernels._linking import EntryCompiler, ask_once, compile_once, note_nothing

INT, FLOAT, NONE = types.int64, types.float64, types.none
INTS, INTS2 = INT[::1], INT[:, ::1]
INTS32, INTS32_2, INTS32_3 = types.int32[::1], types.int32[:, ::1], types.int32[:, :, ::1]
BYTES, WORDS32_2, WORDS = types.uint8[::1], types.uint32[:, ::1], types.uint64[::1]
BYTES2, BOOLS = types.uint8[:, ::1], types.boolean[::1]
FLOATS, FLOATS2, FLOATS3 = FLOAT[::1], FLOAT[:, ::1], FLOAT[:, :, ::1]
READ_BYTES = types.Array(types.uint8, 1, "C", readonly=True)
READ_FLOATS = types.Array(FLOAT, 1, "C", readonly=True)
READ_FLOATS2 = types.Array(FLOAT, 2, "C", readonly=True)
"""Types of arguments. Arrays are C-contiguous; a last digit is the number of axes, if above 1.

A read-only array has another type than a writable one.
"""

ENTRIES: list[Any] = []
"""Every compiled entry, in order of definition."""
SIGNATURES: dict[str, tuple[Any, ...]] = {}
"""Types of the arguments of every entry, by its module and name: ``query.grouping.gap_rows``.

An entry that is compiled for the distance law, too, has a second name for that, which ends in
`BY_DISTANCE`.
"""
BY_DISTANCE = "@distances"


_ENTRY_OPTIONS: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": True,
}  # fmt: skip
"""Options of entries. `_nrt` is numba's counting of references to arrays."""
_LEAF_OPTIONS: dict[str, Any] = _ENTRY_OPTIONS | {"_nrt": False}
_BY_ADDRESS: dict[str, Any] = {"_nrt": False, "no_cpython_wrapper": True}
if IN_WORKER in os.environ:
    _ENTRY_OPTIONS |= {"pipeline_class": EntryCompiler}
    _LEAF_OPTIONS |= {"no_cpython_wrapper": True}
    compile_once()
    ask_once()
    note_nothing()


def fields_of(kind: type, *fields: Any) -> Any:  # noqa: ANN401 - numba's types are untyped
    """Type of a NamedTuple whose fields have those types."""
    return types.BaseTuple.from_types(fields, kind)


def record_of(layout: Any, axes: int = 0) -> Any:  # noqa: ANN401 - likewise
    """Type of an array of records of a layout (`records`): one without axes, or rows of them."""
    return types.Array(from_dtype(layout), axes, "C")


class _Cache(FunctionCache):  # type: ignore[misc]
    """Machine code on disk of one entry.

    What is loaded needs none of what numba compiles with, half a second of imports: a process that
    has all its kernels on disk goes without.

    Machine code for a NamedTuple from outside this package stays in memory. The file that
    lists an entry's machine code names such types by their module, and a process that cannot
    import one of them could read nothing of that file.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401 - numba's types
        """Load the machine code of a signature; None if it is not on disk."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401 - likewise
        """Store the machine code, unless it is for types from outside this package."""
        given, _ = normalize_signature(sig)
        kinds = [kind.dtype if isinstance(kind, types.CPointer) else kind for kind in given]
        classes = [getattr(kind, "instance_class", None) for kind in kinds]
        if all(c is None or c.__module__.startswith("hapticdb.") for c in classes):
            super().save_overload(sig, data)


def entry(
    *signature: Any,  # noqa: ANN401
    also: Mapping[Any, Any] = MappingProxyType({}),
    by_address: bool = False,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a kernel that Python calls with arguments of those types, when it is first called.

    `also` declares the signature for the distance law: some types exchanged. The kernel is
    cached on disk and runs without the interpreter lock. A call with other types is correct, but
    slow the first time, because the kernel is compiled for them then. by_address: only kernels call
    it (`hand.calling`), and it makes no arrays.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        before = config.CACHE_DIR
        config.CACHE_DIR = CACHE_FOLDER
        try:
            compiled = numba.njit(**_ENTRY_OPTIONS | (_BY_ADDRESS if by_address else {}))(function)
            if not config.DISABLE_JIT:
                compiled._cache = _Cache(function)  # noqa: SLF001 - as cache=True sets numba's own
        finally:
            config.CACHE_DIR = before
        ENTRIES.append(compiled)
        module = function.__module__.removeprefix("hapticdb.kernels.")
        name = f"{module}.{function.__name__}"
        SIGNATURES[name] = signature
        if also:
            SIGNATURES[name + BY_DISTANCE] = tuple(also.get(kind, kind) for kind in signature)
        return compiled  # type: ignore[no-any-return]

    return decorate


def leaf(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:  # noqa: ANN401
    """Compile a function that only kernels call; LLVM inlines it if it is small.

    It counts no references, so arrays cost nothing, but it can make none (`maker`). A process that
    only compiles makes no machine code of a leaf alone (`_linking`). Elsewhere a leaf can be called
    from Python, as tests do. numba gives a literal a type of its own; a leaf is compiled without.
    """
    compiled = numba.njit(**_LEAF_OPTIONS | more)(function)
    if not config.DISABLE_JIT:
        search = compiled.get_call_template
        compiled.get_call_template = lambda given, named: search(
            [types.unliteral(kind) for kind in given],
            {name: types.unliteral(kind) for name, kind in named.items()},
        )
    return compiled  # type: ignore[no-any-return]


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a leaf that LLVM always inlines."""
    return leaf(function, forceinline=True)


def maker(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a leaf that makes arrays."""
    return leaf(function, _nrt=True)


def chosen_by_type(choose: Callable[[type], Callable[..., Any]]) -> Callable[..., Any]:
    """Make a leaf whose body is chosen by the type of its first argument, a NamedTuple.

    `choose` gives the body, a plain function of the same arguments. numba compiles it into each
    kernel for the type that the kernel is compiled for, so that the choice costs no time.
    """

    def call(first: Any, *others: Any) -> Any:  # noqa: ANN401
        return choose(type(first))(first, *others)

    @overload(call, strict=False, jit_options=_LEAF_OPTIONS)
    def body(first: Any, *others: Any) -> Any:  # noqa: ANN401, ARG001
        return choose(first.instance_class)

    return call
