"""One source for both targets: leaves of CPU kernels as device functions of CUDA kernels.

numba recompiles a leaf for the GPU at its call in a CUDA kernel. In numba's CUDA simulator
(NUMBA_ENABLE_CUDASIM=1), used by the tests, kernels run in Python on arrays of the simulator's own
type, unsupported by compiled leaves. There a leaf and all its callees run as plain Python.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any

from numba import config, cuda
from numba.core.dispatcher import Dispatcher


def on_gpu(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make a leaf, or a plain function of a law, callable from CUDA kernels."""
    if config.ENABLE_CUDASIM:
        return _as_python(function)
    if isinstance(function, Dispatcher):
        return function
    return cuda.jit(device=True)(function)  # type: ignore[no-any-return]


def _as_python(function: Callable[..., Any]) -> Callable[..., Any]:
    """Copy a function, with its leaves replaced by their plain Python, recursively."""
    plain = getattr(function, "py_func", function)
    if not isinstance(plain, FunctionType):
        return plain
    called = {
        name: _as_python(plain.__globals__[name])
        for name in plain.__code__.co_names
        if isinstance(plain.__globals__.get(name), Dispatcher)
    }
    # a copy with its own globals: the module keeps its compiled leaves
    scope = plain.__globals__ | called
    return FunctionType(
        plain.__code__, scope, plain.__name__, plain.__defaults__, plain.__closure__
    )
