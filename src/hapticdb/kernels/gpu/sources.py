"""One source for both targets: a leaf of the processor's kernels becomes a function of the GPU's.

numba compiles a leaf again where a kernel of the GPU calls it. numba's simulator of a GPU
(NUMBA_ENABLE_CUDASIM=1), on which tests run, calls Python and hands on arrays of its own, which no
compiled leaf takes. There a leaf and all that it calls run as the Python that they were written in.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any

from numba import config, cuda
from numba.core.dispatcher import Dispatcher


def on_gpu(function: Callable[..., Any]) -> Callable[..., Any]:
    """Make a leaf, or the plain function of a law, callable by kernels of the GPU."""
    if config.ENABLE_CUDASIM:
        return _as_python(function)
    if isinstance(function, Dispatcher):
        return function
    return cuda.jit(device=True)(function)  # type: ignore[no-any-return]


def _as_python(function: Callable[..., Any]) -> Callable[..., Any]:
    """Copy a function so that the leaves that it calls are plain Python, too."""
    plain = getattr(function, "py_func", function)
    if not isinstance(plain, FunctionType):
        return plain
    called = {
        name: _as_python(plain.__globals__[name])
        for name in plain.__code__.co_names
        if isinstance(plain.__globals__.get(name), Dispatcher)
    }
    scope = plain.__globals__ | called
    return FunctionType(
        plain.__code__, scope, plain.__name__, plain.__defaults__, plain.__closure__
    )
