"""Compilation of kernels: the only module with numba options.

An entry is called from Python, with declared argument types; its machine code for these is in a set
(`_sets`). For other types, such as a user's law, it is compiled in place, once a process. A leaf is
called by kernels only.
"""

import os
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numba
from numba import config, types
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.extending import overload
from numba.np.numpy_support import from_dtype

from hapticdb.kernels._linking import EntryCompiler, link_leaves_into_entries
from hapticdb.kernels._machine_code import BUILDING
from hapticdb.kernels._sets import code_of

INT, FLOAT, BOOL, NONE = types.int64, types.float64, types.boolean, types.none
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


class Declared(NamedTuple):
    """An entry, compiled by numba, and the types of its arguments."""

    compiled: Any
    signature: tuple[Any, ...]


ENTRIES: dict[str, Declared] = {}
"""Entries of the loaded modules, by module and name: ``query.key_ranges.gap_rows``.

The variant of an entry for the distance law has the suffix `BY_DISTANCE`.
"""
BY_DISTANCE = "@distances"

_ENTRY_OPTIONS: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": True,
}  # fmt: skip
"""Options of entries. `_nrt`: numba's reference counts of arrays."""
_LEAF_OPTIONS: dict[str, Any] = _ENTRY_OPTIONS | {"_nrt": False}
_BY_ADDRESS: dict[str, Any] = {"_nrt": False, "no_cpython_wrapper": True}
_BUILDING = os.environ.get(BUILDING, "")
if _BUILDING:
    _ENTRY_OPTIONS |= {"pipeline_class": EntryCompiler}
    _LEAF_OPTIONS |= {"no_cpython_wrapper": True}
    link_leaves_into_entries()


def fields_of(kind: type, *fields: Any) -> Any:  # noqa: ANN401 - numba's types are untyped
    """Type of a NamedTuple with fields of those types."""
    return types.BaseTuple.from_types(fields, kind)


def record_of(layout: Any, axes: int = 0) -> Any:  # noqa: ANN401 - likewise
    """Type of an array of records of a layout (`records`), of 0 axes or more."""
    return types.Array(from_dtype(layout), axes, "C")


class _Kept(NullCache):  # type: ignore[misc]
    """Machine code of one entry in a set, as numba's cache of it.

    Loading does not import numba's compiler, which takes 0.5 s; it is absent from a process with
    all its kernels in sets.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def _name_of(self, sig: Any) -> str:  # noqa: ANN401 - numba's types
        """Name of the declared signature; empty for another one."""
        given, _ = normalize_signature(sig)
        for name in (self._name, self._name + BY_DISTANCE):
            if name in ENTRIES and ENTRIES[name].signature == given:
                return name
        return ""

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401 - likewise
        """Load the machine code of a signature; None if no set has it."""
        name = "" if _BUILDING else self._name_of(sig)
        code = code_of(name) if name else None
        if code is None:
            return None
        rtsys.initialize(target_context)
        return CompileResult._rebuild(target_context, *pickle.loads(code))  # noqa: S301, SLF001

    def save_overload(self, sig: Any, cres: Any) -> None:  # noqa: ANN401 - likewise
        """Write the machine code of a declared signature to the set under construction."""
        if _BUILDING and (name := self._name_of(sig)):
            part = Path(_BUILDING, f"{name}.{os.getpid()}")
            part.write_bytes(dumps(cres._reduce()))  # noqa: SLF001 - as numba's own cache
            part.rename(Path(_BUILDING, name))


def entry(
    *signature: Any,  # noqa: ANN401
    also: Mapping[Any, Any] = MappingProxyType({}),
    by_address: bool = False,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a kernel for calls from Python with arguments of those types.

    It runs without the interpreter lock. also : replacement of types in the signature for the
    distance law; by_address : the kernel is called by other kernels only (`hand.calling`) and makes
    no arrays.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        compiled = numba.njit(**_ENTRY_OPTIONS | (_BY_ADDRESS if by_address else {}))(function)
        module = function.__module__.removeprefix("hapticdb.kernels.")
        name = f"{module}.{function.__name__}"
        if not config.DISABLE_JIT:
            compiled._cache = _Kept(name)  # noqa: SLF001 - as cache=True sets numba's own
        ENTRIES[name] = Declared(compiled, signature)
        if also:
            by_distance = tuple(also.get(kind, kind) for kind in signature)
            ENTRIES[name + BY_DISTANCE] = Declared(compiled, by_distance)
        return compiled  # type: ignore[no-any-return]

    return decorate


def load_entries(module: str = "") -> None:
    """Load the machine code of every entry of a module, or of all loaded modules."""
    for name, (compiled, signature) in list(ENTRIES.items()):
        if not config.DISABLE_JIT and module in {"", name.rpartition(".")[0]}:
            compiled.compile(signature)


def leaf(function: Callable[..., Any], **more: Any) -> Callable[..., Any]:  # noqa: ANN401
    """Compile a function for calls from kernels; LLVM inlines it if it is small.

    It has no reference counts, so passing arrays is free, but it cannot make any (see `maker`).
    Tests call leaves from Python; a set contains no machine code of a leaf alone (`_linking`).
    Literal arguments are compiled as their general type, not as numba's literal types.
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
    """Compile a leaf with forced inlining."""
    return leaf(function, forceinline=True)


def maker(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a leaf with array allocation."""
    return leaf(function, _nrt=True)


def chosen_by_type(choose: Callable[[type], Callable[..., Any]]) -> Callable[..., Any]:
    """Make a leaf with static dispatch on the type of its first argument, a NamedTuple.

    choose : maps the type to the body, a plain function of the same arguments. numba resolves the
    choice when it compiles a kernel, so a call costs no branch.
    """

    def call(first: Any, *others: Any) -> Any:  # noqa: ANN401
        return choose(type(first))(first, *others)

    @overload(call, strict=False, jit_options=_LEAF_OPTIONS)
    def body(first: Any, *others: Any) -> Any:  # noqa: ANN401, ARG001
        return choose(first.instance_class)

    return call
