"""Find inputs, plants, presets, formats of exports, kinds of reasons and commands by name.

They are entry points of any installed package:

[project.entry-points."q2r2_control.inputs"]
gamepad = "my_package.gamepad:Gamepad"
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from q2r2_control.errors import ConfigError, MissingPackageError
from q2r2_control.extras import plugin_line, require

INPUTS = "q2r2_control.inputs"
PLANTS = "q2r2_control.plants"
PRESETS = "q2r2_control.presets"
EXPORTS = "q2r2_control.exports"
REASONS = "q2r2_control.reasons"
COMMANDS = "q2r2_control.commands"
# By group and name, the folders in plugins/ of packages that are not installed with this one.
_OWN_PACKAGES = {(PLANTS, "franka"): "q2r2_franka", (EXPORTS, "zarr"): "q2r2_zarr"}

# For each class that needs the packages of an extra: the extra, by group and name.
_EXTRAS = {
    (INPUTS, "headset"): "headset",
    (INPUTS, "web"): "web",
    (INPUTS, "webxr"): "web",
    (PLANTS, "fri"): "fri",
    (PLANTS, "mujoco"): "sim",
}


def points_of(group: str) -> Mapping[str, EntryPoint]:
    """Return the entry points that installed packages declare in ``group``, by name in alphabetical order.

    The result is kept, because reading the files of some hundred packages takes longer than loading a cell. The files
    are read again when a folder of ``sys.path`` has changed, as it does when a package is installed.
    """
    folders = tuple((folder, _changed_at(folder)) for folder in sys.path)
    return _points(group, folders)


@lru_cache(maxsize=32)
def _points(group: str, folders: tuple[tuple[str, int], ...]) -> Mapping[str, EntryPoint]:
    """Return the entry points of a group. ``folders`` are all folders of ``sys.path``, with times of change [ns]."""
    return {point.name: point for point in sorted(entry_points(group=group), key=lambda point: point.name)}


def _changed_at(folder: str) -> int:
    try:
        return os.stat(folder or os.curdir).st_mtime_ns
    except OSError:
        return 0


def names_of(group: str) -> tuple[str, ...]:
    """Return the names that installed packages declare in ``group``, in alphabetical order."""
    return tuple(points_of(group))


def package_to_install(group: str, name: str) -> str | None:
    """Return a line that says how to install ``name`` of a group, if a package in plugins/ has it; otherwise None."""
    package = _OWN_PACKAGES.get((group, name))
    return None if package is None else f"it is in a package of its own: {plugin_line(package)}"


def load_class(group: str, name: str) -> Any:
    """Return the class, the preset or the format called ``name``.

    Raises:
        MissingPackageError: If the object needs a package of an extra that is not installed.
        ConfigError: If the group has no such name, or if the object cannot be imported.
    """
    found = points_of(group)
    if name not in found:
        kind = _kind(group)
        if (missing := package_to_install(group, name)) is not None:
            raise ConfigError(f"{kind} {name}: {missing}")
        raise ConfigError(f"{kind} {name!r:.60}: allowed are {', '.join(found)}; installed as entry points {group}")
    if (extra := _EXTRAS.get((group, name))) is not None:
        _require(extra, group, name)
    try:
        return found[name].load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{group}: {name} = {found[name].value}: {error}") from error


def _require(extra: str, group: str, name: str) -> None:
    """Raise :class:`MissingPackageError` if a package of the ``extra`` of a class is missing."""
    try:
        require(extra, f"{_kind(group)} {name}")
    except MissingPackageError as error:
        if extra != "sim":
            raise
        raise MissingPackageError(f"{error}, or choose --plant kinematic") from None


def _kind(group: str) -> str:
    """Return the word for one object of a ``group``, such as "plant"."""
    return group.rpartition(".")[2].removesuffix("s")
