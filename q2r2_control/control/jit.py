"""Compile the functions that run at every tick with Numba."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba.core.event import Listener, install_listener

from q2r2_control.control.kernel_cache import KernelCache
from q2r2_control.control.kernel_compiler import Kernel


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call, with strict IEEE arithmetic (x / 0 is inf) and without Python objects.

    The function must not allocate memory. The compiled code therefore does not count references to arrays.
    """
    return _compiled(function, _nrt=False)


def inlined_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a small function like :func:`kernel`, and inline it into its callers.

    This saves the time of a call for functions that are called for each pair.
    """
    return _compiled(function, _nrt=False, forceinline=True)


def numpy_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that uses NumPy, may allocate memory, and spends its time in BLAS and LAPACK."""
    return _compiled(function)


_kernels: list[Any] = []  # Numba's dispatchers of all kernels in this process.


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    if numba.config.DISABLE_JIT:
        return function
    # Nothing calls a kernel through a C wrapper. Without this option, Numba would compile this wrapper too.
    options |= {"nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    compiled: Any = Kernel(function, options)
    compiled._cache = KernelCache(function)
    _kernels.append(compiled)
    found: Callable[..., Any] = compiled
    return found


class _Progress(Listener):
    """Reports how many kernels have been compiled. Numba's own helpers do not count."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress = progress
        self._done = -1

    def on_start(self, event: Any) -> None:
        if self._done < 0 and event.data["dispatcher"] in _kernels:
            self._done = 0
            self._tell()

    def on_end(self, event: Any) -> None:
        if event.data["dispatcher"] in _kernels:
            self._done += 1
            self._tell()

    def _tell(self) -> None:
        left = sum(not (kernel.overloads or kernel.parts) for kernel in _kernels)
        self._progress(self._done, self._done + left)


@contextmanager
def compiling(progress: Callable[[int, int], None]) -> Iterator[None]:
    """Call ``progress`` with the number of compiled kernels, and the number of kernels that this process may need.

    ``progress`` is called before the first kernel is compiled, and after each kernel. It is not called if all kernels
    come from the cache.
    """
    with install_listener("numba:compile", _Progress(progress)):
        yield


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return a kernel's machine code for the types of these arguments, after one run with them.

    The code does not check the types of its arguments, which saves time. Its arguments must have exactly these types
    and layouts.
    """
    function(*arguments)
    dispatcher: Any = function  # Type checkers do not see that a kernel has the method get_overload.
    code: Callable[..., Any] = dispatcher.get_overload(tuple(numba.typeof(argument) for argument in arguments))
    return code
