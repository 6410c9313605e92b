"""A call of a function of Python from a kernel, by an address that a record has."""

import ctypes
from typing import Any

from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64)
"""The kind of function: no arguments, a number back. It takes the interpreter lock itself. Whoever
has its address keeps it, and it raises nothing, since no kernel can take an error."""


def address_of(function: Any) -> int:  # noqa: ANN401 - a `FUNCTION`
    """Address of a function."""
    return int(ctypes.cast(function, ctypes.c_void_p).value or 0)


if config.DISABLE_JIT:

    def call(address):
        """Call the function at an address."""
        return FUNCTION(int(address))()

else:

    @intrinsic
    def call(typing_context, address):  # noqa: ARG001 - numba's signature
        """Call the function at an address."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            kind = cgutils.ir.FunctionType(cgutils.ir.IntType(64), ())
            return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), ())

        return types.int64(types.int64), generate
