from __future__ import annotations

import ast
import os
import runpy
import shutil
from pathlib import Path

import pytest

from q2r2_control.control import jit, kernel_cache


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the package's sources, from which the name of the cache folder is computed."""
    package = Path(kernel_cache.__file__).parents[1]
    copy = tmp_path / "package"
    for room in ("control", "compliance"):
        shutil.copytree(package / room, copy / room, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(kernel_cache, "__file__", str(copy / "control" / "kernel_cache.py"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return copy


@pytest.mark.parametrize(
    "name", ["control/kernel_model.py", "control/kernel_compiler.py", "compliance/impedance_law.py"]
)
def test_after_an_edit_of_a_compiled_source_old_machine_code_is_not_used(sources: Path, name: str) -> None:
    before = kernel_cache._cache_folder()
    (sources / name).write_text((sources / name).read_text() + "# edited\n")
    edited = kernel_cache._cache_folder()
    (sources / "control" / "tasks" / "new_module.py").write_text("@kernel\ndef one() -> float:\n    return 1.0\n")
    assert len({before, edited, kernel_cache._cache_folder()}) == 3


def test_an_edit_of_a_source_without_kernels_compiles_nothing(sources: Path) -> None:
    before = kernel_cache._cache_folder()
    (sources / "control" / "controller.py").write_text("value = 1\n")
    assert kernel_cache._cache_folder() == before


def name_of(source: Path) -> str:
    """Return the dotted name of a module of the package."""
    parts = source.relative_to(Path(kernel_cache.__file__).parents[2]).with_suffix("").parts
    return ".".join(parts)


@pytest.mark.parametrize("source", kernel_cache.compiled_sources(), ids=name_of)
def test_the_name_of_the_cache_folder_depends_on_every_module_that_a_kernel_uses(source: Path) -> None:
    covered = {name_of(path) for path in kernel_cache.compiled_sources()}
    # Kernels get the values of these modules as arguments, so no constant of them is compiled into a kernel.
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


def test_if_the_cache_cannot_be_written_another_folder_is_used(sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    occupied = sources.parent / "a_file"
    occupied.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(occupied))
    with pytest.warns(RuntimeWarning, match="XDG_CACHE_HOME"):
        folder = kernel_cache._cache_folder()
    assert occupied not in folder.parents
    folder.mkdir(parents=True, exist_ok=True)
    folder.rmdir()


def test_the_two_newest_folders_of_the_cache_are_kept_and_only_older_folders_are_deleted(sources: Path) -> None:
    root = kernel_cache._cache_folder().parent
    (root / "notes").mkdir()
    for age, name in enumerate(("a" * 16, "b" * 16, "c" * 16), start=1):
        (root / name).mkdir()
        os.utime(root / name, ns=(10**9 * (100 - age),) * 2)
    newest = kernel_cache._cache_folder()
    assert {folder.name for folder in root.iterdir()} == {"notes", newest.name, "a" * 16}


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
    """Use a cache folder and a list of kernels that belong to this test."""
    monkeypatch.setattr(kernel_cache, "_FOLDER", str(tmp_path / "machine_code"))
    monkeypatch.setattr(jit, "_kernels", [])
    return tmp_path


def doubled_by(file: Path) -> list[tuple[int, int]]:
    """Run the kernels of :data:`_DOUBLING` from a file, and return the messages about compiling them."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(_DOUBLING)
    told: list[tuple[int, int]] = []
    double = runpy.run_path(str(file))["double"]
    with jit.compiling(lambda done, total: told.append((done, total))):
        assert double(2.0) == 4.0
    return told


def test_kernels_of_a_second_checkout_are_not_compiled_again(own_cache: Path) -> None:
    doubled_by(own_cache / "doubling.py")
    assert doubled_by(own_cache / "elsewhere" / "doubling.py") == []


def test_a_source_that_was_written_again_unchanged_is_not_compiled_again(own_cache: Path) -> None:
    doubled_by(own_cache / "doubling.py")
    source = own_cache / "doubling.py"
    source.write_text(_DOUBLING)
    os.utime(source, (1, 1))
    double = runpy.run_path(str(source))["double"]
    assert double(2.0) == 4.0
    assert sum(double.stats.cache_misses.values()) == 0


def test_progress_counts_compiled_kernels_and_does_not_count_machine_code_from_the_cache(
    own_cache: Path,
) -> None:
    assert doubled_by(own_cache / "doubling.py") == [(0, 2), (1, 2), (2, 2)]
    assert doubled_by(own_cache / "doubling.py") == []
