from __future__ import annotations

import ast
import copy
import os
import pickle
import re
import runpy
import shutil
from collections import namedtuple
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from q2r2_control.control import jit
from q2r2_control.control.jit import bound, kernel, pointee, pointee_at, pointer_to


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the package's sources that the cache folder is named after."""
    package = Path(jit.__file__).parents[1]
    copy = tmp_path / "package"
    for room in ("control", "compliance"):
        shutil.copytree(package / room, copy / room, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(jit, "__file__", str(copy / "control" / "jit.py"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return copy


@pytest.mark.parametrize("name", ["control/kernel_model.py", "control/jit.py", "compliance/impedance_law.py"])
def test_an_edit_of_a_compiled_source_leaves_yesterdays_machine_code_behind(sources: Path, name: str) -> None:
    before = jit._cache_folder()
    (sources / name).write_text((sources / name).read_text() + "# edited\n")
    edited = jit._cache_folder()
    (sources / "control" / "tasks" / "new_module.py").write_text("@kernel\ndef one() -> float:\n    return 1.0\n")
    assert len({before, edited, jit._cache_folder()}) == 3


def test_an_edit_of_a_source_without_kernels_compiles_nothing(sources: Path) -> None:
    before = jit._cache_folder()
    (sources / "control" / "controller.py").write_text("value = 1\n")
    assert jit._cache_folder() == before


def name_of(source: Path) -> str:
    """Dotted name of a module of the package."""
    parts = source.relative_to(Path(jit.__file__).parents[2]).with_suffix("").parts
    return ".".join(parts)


@pytest.mark.parametrize("source", jit.compiled_sources(), ids=name_of)
def test_what_a_kernel_uses_is_covered_by_the_name_of_the_cache(source: Path) -> None:
    covered = {name_of(path) for path in jit.compiled_sources()}
    # No constant of theirs enters a kernel, only what is handed to it.
    harmless = {
        f"q2r2_control.{name}"
        for name in (
            *("types", "errors", "config.control", "config.moving_obstacle"),
            *("control.geometry.finger_openings", "control.moving_obstacles"),
            *("robot.robot", "robot.pairs", "robot.kept_distances", "robot.obstacle_bodies", "robot.turning_fingers"),
        )
    }
    imported = {
        node.module
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("q2r2_control.")
    }
    assert imported <= covered | harmless


def test_a_cache_that_cannot_be_written_is_put_elsewhere(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    occupied = sources.parent / "a_file"
    occupied.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(occupied))
    with pytest.warns(RuntimeWarning, match="XDG_CACHE_HOME"):
        folder = jit._cache_folder()
    assert occupied not in folder.parents
    folder.mkdir(parents=True, exist_ok=True)
    folder.rmdir()


@kernel
def _one_over(value: float) -> float:
    return 1.0 / value


def test_division_by_zero_gives_infinity_instead_of_an_exception() -> None:
    assert _one_over(0.0) == np.inf


def test_a_copy_of_what_is_held_is_held_elsewhere() -> None:
    held = pointer_to((np.ones(3),))
    for other in (copy.deepcopy(held), pickle.loads(pickle.dumps(held))):
        _double_held(other)
        np.testing.assert_array_equal(other.value[0], 2.0)
    np.testing.assert_array_equal(held.value[0], 1.0)


def test_tuples_with_one_name_and_other_fields_are_not_mixed_up() -> None:
    # Their types only: compiled code of types that are not the package's would be kept beside the package's.
    one = namedtuple("Bodies", "first second")  # type: ignore[name-match]
    other = namedtuple("Bodies", "second first")  # type: ignore[name-match]
    values = np.ones(1), np.zeros(1)
    kinds = [jit._Pointer(numba.typeof(kind(*values))) for kind in (one, other, one)]
    assert str(kinds[0]) == str(kinds[1])
    assert kinds[0] != kinds[1]
    assert kinds[0] == kinds[2]


def test_what_is_not_held_is_an_error_and_no_crash() -> None:
    double = bound(_double_held, pointer_to((np.ones(3),)))
    with pytest.raises(AttributeError, match="address"):
        double(None)


@kernel
def _double_held(held: jit.KernelPointer) -> None:
    (values,) = pointee(held)
    for i in range(values.shape[0]):
        values[i] *= 2.0


def test_bound_machine_code_is_the_kernel_s_and_has_run_once() -> None:
    values = np.ones(3)
    double = bound(_double_held, pointer_to((values,)))
    np.testing.assert_array_equal(values, [2.0, 2.0, 2.0])
    others = np.arange(3.0)
    double(pointer_to((others,)))
    np.testing.assert_array_equal(others, [0.0, 2.0, 4.0])
    assert bound(_one_over, 2.0)(4.0) == 0.25


PAGE = Path(__file__).parents[2] / "docs" / "kernels.md"


def test_the_template_compiles_and_sees_what_changes_in_the_model(tmp_path: Path) -> None:
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


_DOUBLING = """
from q2r2_control.control.jit import kernel

@kernel
def part(x):
    return 2.0 * x

@kernel
def double(x):
    return part(x)
"""


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of a test's own, and no kernel but the test's."""
    monkeypatch.setattr(jit, "_FOLDER", str(tmp_path / "machine_code"))
    monkeypatch.setattr(jit, "_kernels", [])
    return tmp_path


def doubled_by(file: Path) -> list[tuple[int, int]]:
    """Run the kernels of :data:`_DOUBLING` from a file; returns what is told of compiling them."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(_DOUBLING)
    told: list[tuple[int, int]] = []
    double = runpy.run_path(str(file))["double"]
    with jit.compiling(lambda done, total: told.append((done, total))):
        assert double(2.0) == 4.0
    return told


def test_each_compiled_kernel_is_told_with_their_number_and_machine_code_from_the_cache_is_not(own_cache: Path) -> None:
    assert doubled_by(own_cache / "doubling.py") == [(0, 2), (1, 2), (2, 2)]
    assert doubled_by(own_cache / "doubling.py") == []


def test_a_second_checkout_compiles_nothing(own_cache: Path) -> None:
    doubled_by(own_cache / "doubling.py")
    assert doubled_by(own_cache / "elsewhere" / "doubling.py") == []


def test_a_touched_source_compiles_nothing(own_cache: Path) -> None:
    doubled_by(own_cache / "doubling.py")
    source = own_cache / "doubling.py"
    source.write_text(_DOUBLING)
    os.utime(source, (1, 1))
    double = runpy.run_path(str(source))["double"]
    assert double(2.0) == 4.0
    assert sum(double.stats.cache_misses.values()) == 0


def test_the_two_newest_versions_are_kept_and_nothing_else_is_deleted(sources: Path) -> None:
    root = jit._cache_folder().parent
    (root / "notes").mkdir()
    for age, name in enumerate(("a" * 16, "b" * 16, "c" * 16), start=1):
        (root / name).mkdir()
        os.utime(root / name, ns=(10**9 * (100 - age),) * 2)
    newest = jit._cache_folder()
    assert {folder.name for folder in root.iterdir()} == {"notes", newest.name, "a" * 16}


def test_numba_still_has_the_inner_modules_that_kernels_stand_on() -> None:
    """Fails in one sentence where a newer Numba changed what jit.py is built on."""
    version = f"numba {numba.__version__} is not what control/jit.py is built on; keep to the bound in pyproject.toml"
    held = pointer_to(_Held(np.arange(3.0), _Part(np.ones(2))))
    try:
        total = _sum_of_held(held)
        from_many = _first_of(jit.pointers_to([held.value, held.value]), 1)
    except Exception as error:
        pytest.fail(f"{version}: {error}")
    assert (total, from_many) == (5.0, 1.0), version
    assert numba.config.OPT == 3, f"{version}: its level of optimisation was not restored"


class _Part(NamedTuple):
    values: Any


class _Held(NamedTuple):
    values: Any
    part: _Part


@kernel
def _sum_of_part(part: _Part) -> float:
    return part.values[0] + part.values[1]


@kernel
def _sum_of_held(pointer: jit.KernelPointer) -> float:
    held = pointee(pointer)
    return held.values[0] + held.values[1] + held.values[2] + _sum_of_part(held.part)


@kernel
def _first_of(pointers: jit.KernelPointers, i: int) -> float:
    return pointee_at(pointers, i).part.values[0]
