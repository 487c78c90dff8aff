"""Find ROS packages, and expand their models by ``xacro``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.extras import install_line

_PLACES = "`packages` of the YAML, AMENT_PREFIX_PATH or ROS_PACKAGE_PATH"


def package_file(url: str, near: Path | None, packages: Mapping[str, str]) -> Path:
    """Return the file of a ``package://NAME/PATH``.

    It is searched in ``packages`` (folders by name), the ROS paths, the folders above ``near`` and example-robot-data.

    Raises:
        ConfigError: If there is no such file.
    """
    name, _, path = url.removeprefix("package://").lstrip("/").partition("/")
    if name and path:
        for folder in _folders(name, near, packages):
            if (file := folder / path).is_file():
                return file.resolve()
    help = f"; export ROS_PACKAGE_PATH=FOLDER names the folder that holds {name}" if name and path else ""
    raise ConfigError(f"{url}: not found in {_PLACES}, nor in a folder above the file that names it{help}")


def package_folder(name: str, near: Path | None, packages: Mapping[str, str]) -> Path:
    """Return the folder of the package ``name``, which is searched in the same folders as in :func:`package_file`.

    Raises:
        ConfigError: If there is no such folder.
    """
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
    from example_robot_data.robots_loader import getModelPath

    yield Path(getModelPath("panda_description")).parent.parent / name


def expand_xacro(file: Path, arguments: Mapping[str, object], packages: Mapping[str, str]) -> str:
    """Return the URDF text of ``file`` with ``arguments`` by name.

    ``$(find NAME)`` is searched like ``package://NAME``.

    Raises:
        ConfigError: If xacro is not installed, or if the file has no such argument.
        RobotError: If xacro cannot expand the file.
    """
    try:
        import xacro
        from xacro import substitution_args
    except ImportError as error:
        raise ConfigError(
            f"{file}: needs the Python package xacro: {install_line('xacro')}, or expand it to .urdf"
        ) from error
    # The texts are those that a user would write on xacro's command line.
    texts = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in arguments.items()}
    given, usual = _Arguments(texts), substitution_args._eval_find

    def find(name: str) -> str:
        return str(package_folder(name, file.parent, packages))

    try:
        # For $(find NAME), xacro asks only ament's Python package, which is not always installed. xacro therefore gets
        # ``find``.
        substitution_args._eval_find = substitution_args._eval_dict["find"] = find
        text: str = xacro.process_file(str(file), mappings=given).toxml()
    # A file may contain Python expressions, which can raise any exception.
    except (Exception, SystemExit) as error:
        inside = next((f" (in {name})" for name in reversed(xacro.filestack or []) if name != str(file)), "")
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise RobotError(f"{file}: xacro cannot expand it: {reason}{inside}") from error
    finally:
        substitution_args._eval_find = substitution_args._eval_dict["find"] = usual
    if unknown := sorted(set(arguments) - given.asked_for):
        allowed = ", ".join(sorted(given.asked_for)) or "none"
        raise ConfigError(f"xacro_args.{unknown[0]:.60}: {file} has no such argument; allowed: {allowed}")
    return text


class _Arguments(dict[str, str]):
    """Arguments by name. They record the names for which the file asks, because xacro ignores all other arguments."""

    def __init__(self, given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.asked_for: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.asked_for.add(str(name))
        return super().__contains__(name)
