"""Compile the hot path with Numba."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba.core.event import Listener, install_listener

from q2r2_control.control.kernel_cache import KernelCache
from q2r2_control.control.kernel_compiler import Kernel


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call: strict IEEE arithmetic, no Python objects, a division by 0 gives inf.

    The function may not allocate memory. References to the arrays of its arguments are therefore not counted.
    """
    return _compiled(function, _nrt=False)


def inlined_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a small function that is called for each pair as a :func:`kernel` that becomes part of its callers."""
    return _compiled(function, _nrt=False, forceinline=True)


def numpy_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of NumPy that may allocate memory, for the few large steps of a tick in BLAS and LAPACK."""
    return _compiled(function)


_kernels: list[Any] = []  # All dispatchers of this process.


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    if numba.config.DISABLE_JIT:
        return function
    # Nothing calls a kernel through its C wrapper, which would be compiled in addition to the one for Python.
    options |= {"nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    compiled: Any = Kernel(function, options)
    compiled._cache = KernelCache(function)
    _kernels.append(compiled)
    found: Callable[..., Any] = compiled
    return found


class _Progress(Listener):
    """Reports how many kernels have been compiled, without Numba's own helpers."""

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
    """Report to ``progress`` the number of compiled kernels, and of those that this process may need.

    It is called before the first kernel is compiled and after each. It is not called if all come from the cache.
    """
    with install_listener("numba:compile", _Progress(progress)):
        yield


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return a kernel's machine code for the types of these arguments, after one run with them.

    The code does not check the types of its arguments, which saves time. Its arguments must have exactly these types
    and layouts.
    """
    function(*arguments)
    dispatcher: Any = function  # At run time, Numba sets get_overload too.
    code: Callable[..., Any] = dispatcher.get_overload(tuple(numba.typeof(argument) for argument in arguments))
    return code
