"""Where ROS packages are: those the cell names, those of the ROS environment, and example-robot-data."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from q2r2_control.errors import ConfigError

_PLACES = "the key packages, AMENT_PREFIX_PATH or ROS_PACKAGE_PATH"


def package_file(url: str, near: Path | None, packages: Mapping[str, str]) -> Path:
    """File of a ``package://NAME/PATH``.

    Looked for in ``packages`` (folders by name), the ROS paths, the folders above ``near`` and example-robot-data.
    Raises :class:`ConfigError`.
    """
    name, _, path = url.removeprefix("package://").lstrip("/").partition("/")
    if name and path:
        for folder in _folders(name, near, packages):
            if (file := folder / path).is_file():
                return file.resolve()
    raise ConfigError(f"{url}: not found in {_PLACES}, nor beside the file that names it")


def package_folder(name: str, near: Path | None, packages: Mapping[str, str]) -> Path:
    """Folder of the package ``name``, looked for as by :func:`package_file`. Raises :class:`ConfigError`."""
    for folder in _folders(name, near, packages):
        if folder.is_dir():
            return folder.resolve()
    raise ConfigError(f"package {name!r:.80}: not found in {_PLACES}, nor around {near}")


def _folders(name: str, near: Path | None, packages: Mapping[str, str]) -> Iterator[Path]:
    if name in packages:
        yield Path(packages[name]).expanduser()
    for variable, below in (("AMENT_PREFIX_PATH", "share"), ("ROS_PACKAGE_PATH", "")):
        yield from (Path(root) / below / name for root in os.environ.get(variable, "").split(os.pathsep) if root)
    if near is not None:
        yield from (folder / name for folder in near.resolve().parents)
    yield _example_robot_data_share() / name


def _example_robot_data_share() -> Path:
    from example_robot_data.robots_loader import getModelPath

    return Path(getModelPath("panda_description")).parent.parent
