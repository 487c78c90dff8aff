from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import typeof
from numba.core.event import RecordingListener, install_listener

from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_compiler import _PartLibrary


@pytest.fixture
def chain() -> tuple[Any, Any, Any]:
    """Return three new kernels. The second kernel calls the first, and the third calls both."""

    @kernel
    def third(x: float) -> float:
        return x / 3.0

    @kernel
    def sixth(x: float) -> float:
        return third(x) / 2.0

    @kernel
    def difference(x: float) -> float:
        return third(x) - sixth(x)

    return third, sixth, difference


def compiled(kinds: dict[Any, Any]) -> Any:
    """Return the only compiled version in ``kinds``.

    ``kinds`` are a kernel's ``overloads``, which Python calls, or its ``parts``, which other kernels call.
    """
    (found,) = kinds.values()
    return found


def test_a_kernel_that_only_other_kernels_call_has_no_machine_code_of_its_own(chain: tuple[Any, Any, Any]) -> None:
    third, sixth, difference = chain
    assert difference(6.0) == 1.0
    for part in (third, sixth):
        assert not part.overloads
        library = compiled(part.parts).library
        assert isinstance(library, _PartLibrary)
        assert library.get_pointer_to_function(compiled(part.parts).fndesc.llvm_func_name) == 0


def test_a_part_of_another_kernel_is_compiled_as_a_whole_when_python_calls_it_and_gives_the_same_result(
    chain: tuple[Any, Any, Any],
) -> None:
    third, sixth, difference = chain
    numbers = np.random.default_rng(1).normal(size=100)
    differences = [difference(x) for x in numbers]
    assert [third(x) - sixth(x) for x in numbers] == differences
    assert not isinstance(compiled(third.overloads).library, _PartLibrary)


def test_after_a_call_from_python_a_kernel_can_become_part_of_another_kernel(chain: tuple[Any, Any, Any]) -> None:
    third, _, difference = chain
    assert (third(6.0), difference(6.0)) == (2.0, 1.0)


def test_after_a_call_from_python_a_kernel_that_uses_max_can_become_part_of_two_kernels() -> None:
    @kernel
    def at_least_one(x: float) -> float:
        return max(x, 1.0) + max(int(x), 3)

    @kernel
    def halved(x: float) -> float:
        return max(at_least_one(x), 2.0) / 2.0

    @kernel
    def doubled(x: float) -> float:
        return 2.0 * at_least_one(x) + max(int(x), 4) + halved(x)

    assert (at_least_one(5.0), halved(5.0), doubled(5.0)) == (10.0, 5.0, 30.0)


def test_a_part_that_cannot_be_compiled_raises_an_exception_and_the_next_kernel_is_compiled_as_a_whole(
    chain: tuple[Any, Any, Any],
) -> None:
    @kernel
    def wrong(x: float) -> float:
        return x.no_such_attribute  # type: ignore[attr-defined]

    @kernel
    def outer(x: float) -> float:
        return wrong(x)

    with pytest.raises(Exception, match="no_such_attribute"):
        outer(1.0)
    third, *_ = chain
    assert third(3.0) == 1.0
    assert typeof(1.0) in next(iter(third.overloads))


def test_if_python_calls_a_kernel_while_another_kernel_is_compiled_the_result_is_right(
    chain: tuple[Any, Any, Any],
) -> None:
    third, _, difference = chain

    def while_compiled(event: Any) -> None:
        called.append(third(6.0))

    called: list[float] = []
    listener = RecordingListener()
    listener.on_end = while_compiled
    with install_listener("numba:compile", listener):
        assert difference(6.0) == 1.0
    assert set(called) == {2.0}
