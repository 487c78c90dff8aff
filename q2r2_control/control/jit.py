"""Compile the hot path with Numba and keep the machine code between runs.

Numba's own cache looks only at the file of the compiled function. A kernel that calls another module's kernel would go
on running that module's old code after an edit. The cache folder is therefore named by a hash of every source file of
this package that machine code is made from. Any edit of one compiles afresh.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numba.extending
import numpy as np
import numpy.typing as npt
from numba import types
from numba.core import cgutils
from numba.core.event import Listener, install_listener
from numba.core.registry import cpu_target

_ROOMS = ("control", "compliance")
_COMPILED = re.compile(r"^@(inlined_|numpy_)?kernel|\bNamedTuple\b", re.MULTILINE)


def compiled_sources() -> list[Path]:
    """Files that hold kernels or the types of their arguments; they take constants from no other file."""
    package = Path(__file__).parents[1]
    sources = sorted(source for room in _ROOMS for source in (package / room).rglob("*.py"))
    return [source for source in sources if _COMPILED.search(source.read_text(encoding="utf-8"))]


def _cache_folder() -> Path:
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in compiled_sources())).hexdigest()[:16]
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "q2r2_control"
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=root):
            pass
    except (OSError, RuntimeError):
        # Numba loads what it finds there as code, so a folder that others could have made will not do.
        root = Path(tempfile.mkdtemp(prefix="q2r2_control-"))
    return root / digest


_FOLDER = str(_cache_folder())

# No type checker knows what Numba sets at run time.
config: Any = numba.config
extending: Any = numba.extending


class _Pointer(types.Type):
    """Kernels' type of a :class:`KernelPointer`."""

    def __init__(self, pointee: Any) -> None:
        self.pointee = pointee
        super().__init__(name=f"KernelPointer({pointee})")

    @property
    def key(self) -> Any:
        return self.pointee  # whose name does not tell of its fields


extending.register_model(_Pointer)(extending.models.OpaqueModel)


class KernelPointer:
    """A named tuple of arrays behind one pointer: made by :func:`pointer_to`, read in a kernel by :func:`pointee`."""

    __slots__ = ("address", "kind", "memory", "value")

    def __init__(self, value: Any, memory: npt.NDArray[np.uint8]) -> None:
        self.value = value  # whose arrays have to stay
        self.memory = memory
        self.address = memory.ctypes.data
        self.kind = _Pointer(numba.typeof(value))

    def __reduce__(self) -> Any:
        return pointer_to, (self.value,)  # a copy has an address of its own


@extending.typeof_impl.register(KernelPointer)
def _kind_of(pointer: KernelPointer, context: Any) -> _Pointer:
    return pointer.kind


@extending.unbox(_Pointer)
def _unbox(kind: _Pointer, boxed: Any, context: Any) -> Any:
    builder, python = context.builder, context.pyapi
    pointer = cgutils.alloca_once_value(builder, context.context.get_constant_null(kind))
    address = python.object_getattr_string(boxed, "address")
    with builder.if_then(cgutils.is_not_null(builder, address)):
        builder.store(python.long_as_voidptr(address), pointer)
        python.decref(address)
    return extending.NativeValue(builder.load(pointer), is_error=python.c_api_error())


@extending.intrinsic
def pointee(typing_context: Any, pointer: Any) -> Any:
    """The named tuple behind ``pointer``, in a kernel. No reference is counted: the caller keeps the pointer."""

    def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_data_type(pointer.pointee)
        return context.unpack_value(builder, pointer.pointee, builder.bitcast(arguments[0], kind.as_pointer()))

    return pointer.pointee(pointer), read


@extending.intrinsic
def _put(typing_context: Any, value: Any, memory: Any) -> Any:
    """Write a value into an array of bytes."""

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        to = context.make_array(memory)(context, builder, arguments[1]).data
        kind = context.get_data_type(value)
        context.pack_value(builder, value, arguments[0], builder.bitcast(to, kind.as_pointer()))

    return types.void(value, memory), write


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call; strict IEEE arithmetic, no Python objects, division by 0 gives inf.

    It may allocate nothing, so that references to the arrays of its calls are not counted.
    """
    return _compiled(function, _nrt=False)


def inlined_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """A :func:`kernel` that becomes part of its callers: for a small one that is handed a whole model and data."""
    return _compiled(function, _nrt=False, forceinline=True)


def numpy_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of NumPy that may allocate: for a few large steps in a tick that BLAS and LAPACK do."""
    return _compiled(function)


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    previous = config.CACHE_DIR
    config.CACHE_DIR = _FOLDER  # read once, while decorating
    try:
        compiled: Callable[..., Any] = numba.njit(function, cache=True, error_model="numpy", nogil=True, **options)
    finally:
        config.CACHE_DIR = previous
    return compiled


class _FirstCompilation(Listener):
    """Calls once."""

    def __init__(self, notice: Callable[[], None]) -> None:
        self._notice: Callable[[], None] | None = notice

    def on_start(self, event: Any) -> None:
        notice, self._notice = self._notice, None
        if notice is not None:
            notice()

    def on_end(self, event: Any) -> None:
        """Nothing is done."""


@contextmanager
def calling_before_compiling(notice: Callable[[], None]) -> Iterator[None]:
    """Call ``notice`` once, before the first kernel that is compiled; never where all come from the cache."""
    with install_listener("numba:compile", _FirstCompilation(notice)):
        yield


@kernel
def _write(value: Any, memory: npt.NDArray[np.uint8]) -> None:
    _put(value, memory)


def pointer_to(value: Any) -> KernelPointer:
    """Put ``value``, a named tuple of arrays, numbers and more of its kind, behind a pointer."""
    context = cpu_target.target_context
    memory = np.zeros(context.get_abi_sizeof(context.get_data_type(numba.typeof(value))), dtype=np.uint8)
    _write(value, memory)
    return KernelPointer(value, memory)


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """A kernel's machine code for arguments of the types of these, with which it runs once.

    It does not look at the types of its arguments, which saves time: hand it exactly these types and layouts.
    """
    function(*arguments)
    dispatcher: Any = function  # get_overload is set by Numba at run time too
    code: Callable[..., Any] = dispatcher.get_overload(tuple(numba.typeof(argument) for argument in arguments))
    return code
