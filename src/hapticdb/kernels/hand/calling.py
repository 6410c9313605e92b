"""A call of a function of Python from a kernel, by an address that a record has."""

import ctypes

from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64)
"""The kind of function: no arguments, a number back. It takes the interpreter lock itself."""

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
