from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from q2r2_control.control.jit import bound, kernel
from q2r2_control.control.kernel_pointers import (
    KernelPointer,
    KernelPointers,
    pointee,
    pointee_at,
    pointer_to,
    pointers_to,
)
from q2r2_control.types import Array


@kernel
def _one_over(value: float) -> float:
    return 1.0 / value


def test_division_by_zero_gives_infinity_instead_of_an_exception() -> None:
    assert _one_over(0.0) == np.inf


@kernel
def _double(values: Array) -> None:
    for i in range(values.shape[0]):
        values[i] *= 2.0


def test_the_function_bound_runs_a_kernel_once_and_returns_its_machine_code() -> None:
    values = np.ones(3)
    double = bound(_double, values)
    np.testing.assert_array_equal(values, [2.0, 2.0, 2.0])
    others = np.arange(3.0)
    double(others)
    np.testing.assert_array_equal(others, [0.0, 2.0, 4.0])
    assert bound(_one_over, 2.0)(4.0) == 0.25


PAGE = Path(__file__).parents[2] / "docs" / "kernels.md"


def test_the_example_in_kernels_md_compiles_and_sees_changes_in_the_model(tmp_path: Path) -> None:
    (template,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    source = tmp_path / "spring.py"
    source.write_text(template)
    found: dict[str, Any] = {"__name__": "spring"}
    exec(compile(template, str(source), "exec"), found)
    found["model"].stiffness[0] = 10.0
    assert found["torque"](found["pointer"], found["q"], found["tau"])
    np.testing.assert_allclose(found["tau"], -1.0)
    found["q"][3] = np.nan
    assert not found["torque"](found["pointer"], found["q"], found["tau"])


def test_numba_still_has_the_inner_modules_that_kernels_need() -> None:
    """If a newer Numba has changed the modules that kernels need, this test fails with one clear sentence."""
    version = (
        f"control/kernel_compiler.py does not work with numba {numba.__version__}: keep to the bound in pyproject.toml"
    )
    held = pointer_to(_Held(np.arange(3.0), _Part(np.ones(2))))
    try:
        total = _sum_of_held(held)
        from_many = _first_of(pointers_to([held.value, held.value]), 1)
    except Exception as error:
        pytest.fail(f"{version}: {error}")
    assert (total, from_many) == (5.0, 1.0), version


class _Part(NamedTuple):
    values: Any


class _Held(NamedTuple):
    values: Any
    part: _Part


@kernel
def _sum_of_part(part: _Part) -> float:
    return part.values[0] + part.values[1]


@kernel
def _sum_of_held(pointer: KernelPointer) -> float:
    held = pointee(pointer)
    return held.values[0] + held.values[1] + held.values[2] + _sum_of_part(held.part)


@kernel
def _first_of(pointers: KernelPointers, i: int) -> float:
    return pointee_at(pointers, i).part.values[0]
