"""Indirect calls from a kernel: of a Python callback, or of another kernel's machine code."""

import ctypes
from typing import Any

from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64)
"""Type of a callback: no arguments, int64 result. ctypes takes the interpreter lock. The owner of
its address must keep it alive, and it must not raise: a kernel cannot receive the error."""


def address_of(function: Any) -> int:  # noqa: ANN401 - a `FUNCTION`
    """Address of a `FUNCTION`, valid during its lifetime."""
    return int(ctypes.cast(function, ctypes.c_void_p).value or 0)


def address_of_kernel(kernel: Any, types_of_arguments: tuple[Any, ...]) -> int:  # noqa: ANN401
    """Address of an entry's machine code for arguments of these numba types, compiled if new."""
    if config.DISABLE_JIT:
        _PLAIN[id(kernel)] = kernel
        return id(kernel)
    kernel.compile(types_of_arguments)
    code = kernel.overloads[types_of_arguments]
    return int(code.library.get_pointer_to_function(code.fndesc.llvm_func_name))


_PLAIN: dict[int, Any] = {}

if config.DISABLE_JIT:

    def call(address):
        """Call the `FUNCTION` at an address."""
        return FUNCTION(int(address))()

    def call_kernel(address, one, two, three):
        """Call the Python kernel registered under an address."""
        return _PLAIN[int(address)](one, two, three)

else:

    @intrinsic
    def call_kernel(typing_context, address, one, two, three):  # noqa: ARG001 - numba's signature
        """Call the kernel at an address for its int64 result; its errors propagate.

        Arguments are records, passed by pointer, or integers; an integer may be the address for one
        of the kernel's pointer parameters.
        """

        def generate(context, builder, signature, arguments):
            kinds, calls = signature.args[1:], context.call_conv
            kind = calls.get_function_type(signature.return_type, kinds)
            kernel = builder.inttoptr(arguments[0], kind.as_pointer())
            # numba's own calling convention: the status carries an exception of the callee
            status, result = calls.call_function(
                builder, kernel, signature.return_type, kinds, arguments[1:]
            )
            with cgutils.if_unlikely(builder, status.is_error):  # a user's law may raise
                calls.return_status_propagate(builder, status)
            return result

        return types.int64(types.int64, one, two, three), generate

    @intrinsic
    def call(typing_context, address):  # noqa: ARG001 - numba's signature
        """Call the `FUNCTION` at an address."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            kind = cgutils.ir.FunctionType(cgutils.ir.IntType(64), ())
            return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), ())

        return types.int64(types.int64), generate
