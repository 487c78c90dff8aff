"""Compile the hot path with Numba and keep the machine code between runs.

Numba's own cache looks only at the path and the time of the compiled function's file. A kernel that calls another
module's kernel would go on running that module's old code after an edit, and a second checkout would compile everything
again. The cache folder is therefore named by a hash of every source file of this package that machine code is made
from, and each kernel in it is found by its module's name and its file's content.

Numba optimises a kernel together with all kernels that it calls, so a chain of eleven calls would be optimised eleven
times. Only a kernel that Python calls is optimised here. The kernels that are compiled on its behalf are not: LLVM
optimises them as parts of it.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
import numba.extending
import numpy as np
import numpy.typing as npt
from numba import types
from numba.core import cgutils
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.config import _OptLevel
from numba.core.dispatcher import Dispatcher
from numba.core.event import Listener, install_listener, register
from numba.core.imputils import lower_getattr_generic
from numba.core.registry import cpu_target
from numba.core.typing.templates import AttributeTemplate, infer_getattr

_ROOMS = ("control", "compliance")
_COMPILED = re.compile(r"^@(inlined_|numpy_)?kernel|\bNamedTuple\b", re.MULTILINE)
_VERSION = re.compile("[0-9a-f]{16}")


def compiled_sources() -> list[Path]:
    """Files that hold kernels or the types of their arguments; they take constants from no other file."""
    package = Path(__file__).parents[1]
    sources = sorted(source for room in _ROOMS for source in (package / room).rglob("*.py"))
    return [source for source in sources if _COMPILED.search(source.read_text(encoding="utf-8"))]


def _cache_folder() -> Path:
    """The folder of this version's machine code; makes it the newest and deletes all but the two newest.

    A folder that another process has loaded from may be deleted: its machine code is in memory, and what that process
    still compiles is written anew. Where the cache cannot be written, what it holds is still used.
    """
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in compiled_sources())).hexdigest()[:16]
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "q2r2_control"
        folder = root / digest
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            if any(folder.rglob("*.nbi")):
                return folder  # compiled before, and only to be read
            raise
        os.utime(folder)
        _delete_old_versions(root)
        return folder
    except (OSError, RuntimeError) as error:
        # Numba loads what it finds there as code, so a folder that others could have made will not do.
        warnings.warn(
            f"compiled kernels cannot be kept: {error}. Every start compiles them anew; set XDG_CACHE_HOME to a folder "
            "that can be written",
            RuntimeWarning,
            stacklevel=2,
        )
        return Path(tempfile.mkdtemp(prefix="q2r2_control-")) / digest


def _delete_old_versions(root: Path) -> None:
    """Delete all but the two versions that were used last."""
    used = []
    for folder in root.iterdir():
        try:
            if _VERSION.fullmatch(folder.name) and not folder.is_symlink():
                used.append((folder.stat().st_mtime_ns, folder))
        except FileNotFoundError:
            continue  # another process deleted it
    for _, folder in sorted(used)[:-2]:
        shutil.rmtree(folder, ignore_errors=True)


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


class _Pointers(types.Type):
    """Kernels' type of :class:`KernelPointers`."""

    def __init__(self, pointee: Any) -> None:
        self.pointee = pointee
        super().__init__(name=f"KernelPointers({pointee})")

    @property
    def key(self) -> Any:
        return self.pointee


for _kind in (_Pointer, _Pointers):
    extending.register_model(_kind)(extending.models.OpaqueModel)


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


class KernelPointers:
    """Named tuples of one type behind one pointer: made by :func:`pointers_to`, read by :func:`pointee_at`."""

    __slots__ = ("address", "kind", "memory", "pointers")

    def __init__(self, pointers: list[KernelPointer]) -> None:
        self.pointers = pointers
        self.memory = np.array([pointer.address for pointer in pointers], dtype=np.intp)
        self.address = self.memory.ctypes.data
        self.kind = _Pointers(pointers[0].kind.pointee)

    def __reduce__(self) -> Any:
        return pointers_to, ([pointer.value for pointer in self.pointers],)  # a copy has addresses of its own


@extending.typeof_impl.register(KernelPointer)
@extending.typeof_impl.register(KernelPointers)
def _kind_of(pointer: KernelPointer | KernelPointers, context: Any) -> _Pointer | _Pointers:
    return pointer.kind


@extending.unbox(_Pointer)
@extending.unbox(_Pointers)
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
    """The tuple behind ``pointer``, in a kernel. No reference is counted: the caller keeps the pointer.

    A named tuple stays behind its pointer, and each attribute is read where it is used. Kernels hand one address to
    each other instead of the hundreds of numbers that a model's arrays consist of, which makes less code to compile.
    """
    if isinstance(pointer.pointee, types.BaseNamedTuple):
        return pointer(pointer), lambda context, builder, signature, arguments: arguments[0]

    def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_data_type(pointer.pointee)
        return context.unpack_value(builder, pointer.pointee, builder.bitcast(arguments[0], kind.as_pointer()))

    return pointer.pointee(pointer), read


@extending.intrinsic
def pointee_at(typing_context: Any, pointers: Any, index: Any) -> Any:
    """The named tuple of ``index`` among :class:`KernelPointers`, in a kernel; as :func:`pointee` gives it."""

    def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        addresses = builder.bitcast(arguments[0], cgutils.voidptr_t.as_pointer())
        return _invariant(builder, builder.load(builder.gep(addresses, [arguments[1]])))

    return _Pointer(pointers.pointee)(pointers, types.intp), read


def _invariant(builder: Any, loaded: Any) -> Any:
    """Tell LLVM that a loaded value never changes: what is behind a pointer is written once, before any kernel runs."""
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


@infer_getattr
class _PointerAttribute(AttributeTemplate):
    """Types of the attributes of a named tuple behind a pointer."""

    key = _Pointer

    def generic_resolve(self, pointer: Any, name: str) -> Any:
        """Returns the type of an attribute, None if there is no such attribute."""
        fields = getattr(pointer.pointee, "fields", ())
        if name not in fields:
            return None
        kind = pointer.pointee.types[fields.index(name)]
        return _Pointer(kind) if isinstance(kind, types.BaseNamedTuple) else kind


@lower_getattr_generic(_Pointer)
def _read_attribute(context: Any, builder: Any, pointer: Any, value: Any, name: str) -> Any:
    """Read an array or a number behind a pointer; of a nested named tuple, only its address."""
    index = pointer.pointee.fields.index(name)
    kind = pointer.pointee.types[index]
    whole = builder.bitcast(value, context.get_data_type(pointer.pointee).as_pointer())
    member = cgutils.gep_inbounds(builder, whole, 0, index)
    if isinstance(kind, types.BaseNamedTuple):
        return builder.bitcast(member, cgutils.voidptr_t)
    return context.data_model_manager[kind].from_data(builder, _invariant(builder, builder.load(member)))


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


class _ContentLocator(_CacheLocator):
    """Finds a function's machine code by the name of its module and the content of its file, wherever that is."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file  # which the cache names in a warning
        self._folder = str(Path(_FOLDER) / re.sub(r"\W", "_", function.__module__))
        self._line = function.__code__.co_firstlineno
        self._stamp = hashlib.sha256(Path(file).read_bytes()).hexdigest()

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _ContentLocator:
        return cls(py_func, py_file)


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes = (_ContentLocator,)


class _KernelCache(FunctionCache):
    """Numba's cache, with another way to find a file; it is only read where it cannot be written."""

    _impl_class = _KernelCacheImpl

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # the kernel works all the same, and the next start compiles it again
            super().save_overload(sig, data)


_kernels: list[Any] = []  # every dispatcher of this process


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    # Nothing calls a kernel through its C wrapper, which would be compiled beside the one for Python.
    compiled: Any = numba.njit(function, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options)
    if isinstance(compiled, Dispatcher):  # and not with NUMBA_DISABLE_JIT
        dispatcher: Any = compiled
        dispatcher._cache = _KernelCache(function)
        _kernels.append(dispatcher)
    found: Callable[..., Any] = compiled
    return found


_NO_OPTIMISATION = _OptLevel(0)


class _OutermostOptimised(Listener):
    """Leaves unoptimised what is compiled as a part of a kernel; Numba compiles one function at a time."""

    def __init__(self) -> None:
        self._outer: list[tuple[bool, Any]] = []  # of each level: whether a kernel is among those around, and its OPT

    def on_start(self, event: Any) -> None:
        within = bool(self._outer) and self._outer[-1][0]
        self._outer.append((within or event.data["dispatcher"] in _kernels, config.OPT))
        if within:
            config.OPT = _NO_OPTIMISATION

    def on_end(self, event: Any) -> None:
        _, config.OPT = self._outer.pop()


register("numba:compile", _OutermostOptimised())


class _Progress(Listener):
    """Tells how many kernels have been compiled; helpers of Numba's own do not count."""

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
        left = sum(not kernel.overloads for kernel in _kernels)
        self._progress(self._done, self._done + left)


@contextmanager
def compiling(progress: Callable[[int, int], None]) -> Iterator[None]:
    """Tell ``progress`` as kernels are compiled: how many are done, of how many that this process may need.

    It is called before the first one, and after each; never where all come from the cache.
    """
    with install_listener("numba:compile", _Progress(progress)):
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


def pointers_to(values: list[Any]) -> KernelPointers:
    """Put ``values``, one or more named tuples of one type, behind a pointer to all of them."""
    return KernelPointers([pointer_to(value) for value in values])


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """A kernel's machine code for arguments of the types of these, with which it runs once.

    It does not look at the types of its arguments, which saves time: hand it exactly these types and layouts.
    """
    function(*arguments)
    dispatcher: Any = function  # get_overload is set by Numba at run time too
    code: Callable[..., Any] = dispatcher.get_overload(tuple(numba.typeof(argument) for argument in arguments))
    return code
