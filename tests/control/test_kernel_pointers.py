from __future__ import annotations

import copy
import pickle
from collections import namedtuple
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.control.jit import bound, kernel
from q2r2_control.control.kernel_pointers import KernelPointer, pointee, pointer_to


def test_a_copy_of_a_pointer_has_its_own_memory() -> None:
    held = pointer_to((np.ones(3),))
    for other in (copy.deepcopy(held), pickle.loads(pickle.dumps(held))):
        _double_held(other)
        np.testing.assert_array_equal(other.value[0], 2.0)
    np.testing.assert_array_equal(held.value[0], 1.0)


def test_named_tuples_with_the_same_name_and_different_fields_have_different_types() -> None:
    # The test compares only types. If it compiled code for these types, the package's cache would keep this code.
    one = namedtuple("Bodies", "first second")  # type: ignore[name-match]
    other = namedtuple("Bodies", "second first")  # type: ignore[name-match]
    values = np.ones(1), np.zeros(1)
    kinds = [pointer_to(kind(*values)).numba_type for kind in (one, other, one)]
    assert str(kinds[0]) == str(kinds[1])
    assert kinds[0] != kinds[1]
    assert kinds[0] == kinds[2]


def test_every_pointer_has_the_type_that_numba_gives_its_value() -> None:
    array, frozen = np.ones((2, 2)), np.ones((2, 2))
    frozen.flags.writeable = False
    parts = [array, array.T, array[:, :1], array[0], frozen, array > 0.0, np.arange(2), 1, 1.0, pointer_to((array,))]
    for part in [*parts, *reversed(parts)]:
        assert pointer_to((part, (array, part))).numba_type.pointee == numba.typeof((part, (array, part)))


def test_an_argument_without_an_address_raises_an_error_and_does_not_crash_the_process() -> None:
    double = bound(_double_held, pointer_to((np.ones(3),)))
    with pytest.raises(AttributeError, match="address"):
        double(None)


@kernel
def _double_held(held: KernelPointer) -> None:
    (values,) = pointee(held)
    for i in range(values.shape[0]):
        values[i] *= 2.0


@pytest.mark.parametrize(
    "value", [(True,), ("a word",), (np.ones(2), None), ([1.0],)], ids=["bool", "text", "none", "list"]
)
def test_a_pointer_to_an_unsupported_value_is_refused(value: tuple[object, ...]) -> None:
    with pytest.raises(TypeError, match="cannot be behind a kernel's pointer"):
        pointer_to(value)


class _All(NamedTuple):
    number: float
    whole: int
    part: tuple[npt.NDArray[np.int64]]
    turned: npt.NDArray[np.float64]


@kernel
def _read_all(pointer: KernelPointer, out: npt.NDArray[np.float64]) -> None:
    value = pointee(pointer)
    out[0], out[1] = value.number, value.whole
    out[2], out[3] = value.part[0][1], value.turned[1, 0]


def test_a_kernel_reads_through_a_pointer_what_python_wrote() -> None:
    out = np.zeros(4)
    _read_all(pointer_to(_All(-0.5, 7, (np.array([3, 4]),), np.arange(6.0).reshape(2, 3).T)), out)
    np.testing.assert_array_equal(out, [-0.5, 7.0, 4.0, 1.0])
