"""Pass a model or its data to kernels by one address, so that there is less code to compile.

A named tuple of arrays is written to memory once, in the layout of Numba's own struct. Kernels pass its address to each
other, and read each attribute where they use it. Without such an address, they would pass the hundreds of numbers with
which Numba represents a model's arrays.
"""

from __future__ import annotations

from typing import Any

import numba
import numba.extending
import numpy as np
import numpy.typing as npt
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic
from numba.core.registry import cpu_target
from numba.core.typing.templates import AttributeTemplate, infer_getattr

# Numba defines these names at run time, where type checkers cannot see them.
extending: Any = numba.extending


class _Address(types.Type):
    """The type of an address in a kernel. Two such types are equal if the values at the addresses have equal types."""

    def __init__(self, pointee: Any) -> None:
        self.pointee = pointee
        super().__init__(name=f"{type(self).__name__}({pointee})")

    @property
    def key(self) -> Any:
        """The type of the value. The name is not used, because two different named tuples may have the same name."""
        return self.pointee


class _Pointer(_Address):
    """The type of a :class:`KernelPointer` in kernels."""


class _Pointers(_Address):
    """The type of :class:`KernelPointers` in kernels."""


for _kind in (_Pointer, _Pointers):
    extending.register_model(_kind)(extending.models.OpaqueModel)


class KernelPointer:
    """A pointer to a named tuple of arrays. :func:`pointer_to` makes it, and :func:`pointee` reads it in a kernel."""

    __slots__ = ("address", "memory", "numba_type", "value")

    def __init__(self, value: Any, memory: npt.NDArray[np.int64], numba_type: _Pointer) -> None:
        self.value = value  # This reference keeps the arrays of the value in memory.
        self.memory = memory
        self.address = memory.ctypes.data
        self.numba_type = numba_type

    def __reduce__(self) -> Any:
        # A copied or unpickled pointer is made anew, because the copied value lies at another address.
        return pointer_to, (self.value,)


class KernelPointers:
    """A pointer to named tuples of one type. :func:`pointers_to` makes it, and :func:`pointee_at` reads it."""

    __slots__ = ("address", "memory", "numba_type", "pointers")

    def __init__(self, pointers: list[KernelPointer]) -> None:
        self.pointers = pointers
        self.memory = np.array([pointer.address for pointer in pointers], dtype=np.intp)
        self.address = self.memory.ctypes.data
        self.numba_type = _Pointers(pointers[0].numba_type.pointee)

    def __reduce__(self) -> Any:
        # Copied or unpickled pointers are made anew, because the copied values lie at other addresses.
        return pointers_to, ([pointer.value for pointer in self.pointers],)


@extending.typeof_impl.register(KernelPointer)
@extending.typeof_impl.register(KernelPointers)
def _kind_of(pointer: KernelPointer | KernelPointers, context: Any) -> _Pointer | _Pointers:
    return pointer.numba_type


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
    """Return, in a kernel, the value to which ``pointer`` points.

    A named tuple stays in memory, and each of its attributes is read where it is used. No reference is counted, so the
    caller of the kernel has to keep the value.
    """
    if isinstance(pointer.pointee, types.BaseNamedTuple):
        return pointer(pointer), lambda context, builder, signature, arguments: arguments[0]

    def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_data_type(pointer.pointee)
        return context.unpack_value(builder, pointer.pointee, builder.bitcast(arguments[0], kind.as_pointer()))

    return pointer.pointee(pointer), read


@extending.intrinsic
def pointee_at(typing_context: Any, pointers: Any, index: Any) -> Any:
    """Return, in a kernel, the named tuple with the ``index`` in :class:`KernelPointers`, as :func:`pointee` does."""

    def read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        addresses = builder.bitcast(arguments[0], cgutils.voidptr_t.as_pointer())
        return _invariant(builder, builder.load(builder.gep(addresses, [arguments[1]])))

    return _Pointer(pointers.pointee)(pointers, types.intp), read


def _invariant(builder: Any, loaded: Any) -> Any:
    """Tell LLVM that a loaded value never changes. The memory of a pointer is written once, before any kernel runs."""
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


@infer_getattr
class _PointerAttribute(AttributeTemplate):
    """Finds the types of the attributes of a named tuple to which a pointer points."""

    key = _Pointer

    def generic_resolve(self, pointer: Any, name: str) -> Any:
        """Return the type of an attribute; None if there is no such attribute."""
        fields = getattr(pointer.pointee, "fields", ())
        if name not in fields:
            return None
        kind = pointer.pointee.types[fields.index(name)]
        return _Pointer(kind) if isinstance(kind, types.BaseNamedTuple) else kind


@lower_getattr_generic(_Pointer)
def _read_attribute(context: Any, builder: Any, pointer: Any, value: Any, name: str) -> Any:
    """Read an attribute of the named tuple to which a pointer points. For a nested named tuple, return its address."""
    index = pointer.pointee.fields.index(name)
    kind = pointer.pointee.types[index]
    whole = builder.bitcast(value, context.get_data_type(pointer.pointee).as_pointer())
    member = cgutils.gep_inbounds(builder, whole, 0, index)
    if isinstance(kind, types.BaseNamedTuple):
        return builder.bitcast(member, cgutils.voidptr_t)
    return context.data_model_manager[kind].from_data(builder, _invariant(builder, builder.load(member)))


def _words(value: Any) -> list[int]:
    """Return the words of 8 bytes with which Numba represents ``value`` in memory."""
    if isinstance(value, tuple):
        return [word for part in value for word in _words(part)]
    if isinstance(value, np.ndarray):
        # The owner of the pointer keeps the array, so no reference is counted, and Numba's two pointers to owners are
        # 0.
        owners = [0, 0]
        return [*owners, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides]
    if isinstance(value, KernelPointer | KernelPointers):
        return [value.address]
    if isinstance(value, float):
        return [int(np.float64(value).view(np.int64))]
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return [int(value)]
    raise TypeError(
        f"{value!r} cannot be behind a kernel's pointer: allowed are arrays, numbers, pointers and their tuples"
    )


def _form(value: Any) -> Any:
    """Return a key with everything on which Numba's type of ``value`` depends. It is computed faster than the type."""
    if isinstance(value, tuple):
        return type(value), *[_form(part) for part in value]
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim, value.flags.num
    return value.numba_type if isinstance(value, KernelPointer | KernelPointers) else type(value)


# The pointer types, by the result of :func:`_form` for the value. Each type is computed once, because a controller has
# hundreds of pointers.
_kinds: dict[Any, _Pointer] = {}


def _kind_of_pointer_to(value: Any, size: int) -> _Pointer:
    """Return the type that a pointer to ``value`` has in kernels. ``size`` is the size of the value [bytes]."""
    form = _form(value)
    if form not in _kinds:
        kind, context = _Pointer(numba.typeof(value)), cpu_target.target_context
        if size != context.get_abi_sizeof(context.get_data_type(kind.pointee)):
            raise TypeError(f"Numba {numba.__version__} lays out {type(value).__name__} in another way than expected")
        _kinds[form] = kind
    return _kinds[form]


def pointer_to(value: Any) -> KernelPointer:
    """Return a pointer to ``value``, a named tuple of arrays, numbers and further named tuples.

    Raises:
        TypeError: If a part of ``value`` is anything else.
    """
    memory = np.array(_words(value), dtype=np.int64)
    return KernelPointer(value, memory, _kind_of_pointer_to(value, memory.nbytes))


def pointers_to(values: list[Any]) -> KernelPointers:
    """Return one pointer to all ``values``, which are one or more named tuples of one type."""
    return KernelPointers([pointer_to(value) for value in values])
