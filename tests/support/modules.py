"""Functions that load scripts as modules, install small packages, and read blocks of code in the docs."""

from __future__ import annotations

import importlib.util
import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]


def install(folder: Path, package: str, source: str, entries: str) -> None:
    """Install a package of one module with its entry points, as pip does. ``folder`` has to be on the path."""
    (folder / f"{package}.py").write_text(source)
    (folder / f"{package}-1.0.dist-info").mkdir()
    (folder / f"{package}-1.0.dist-info/entry_points.txt").write_text(entries)


def entry_points_of(plugin: str) -> str:
    """Return the entry points in the pyproject.toml of a folder in ``plugins``, as an installed package has them."""
    about = tomllib.loads((ROOT / "plugins" / plugin / "pyproject.toml").read_text(encoding="utf-8"))
    lines: list[str] = []
    for group, entries in about["project"]["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {at}" for name, at in entries.items())]
    return "\n".join(lines)


def blocks_of(page: str, language: str) -> list[str]:
    """Return the blocks of code in a page, unchanged."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def load_script(path: str) -> ModuleType:
    """Return the script at ``path`` in the repository as a module."""
    file = ROOT / path
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # ``dataclasses`` looks up the types of fields in sys.modules.
    spec.loader.exec_module(module)
    return module
