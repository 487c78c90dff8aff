"""Read the YAML of a cell, and name the line of each fault."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from q2r2_control.config.cell import Config
from q2r2_control.config.resources import find_resource
from q2r2_control.config.strict import config_error
from q2r2_control.config.yaml_text import SafeLoader
from q2r2_control.errors import ConfigError


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read and check a cell's YAML.

    ``path`` is looked up from the working directory first, and then among the files shipped with the package. Relative
    paths in the file are first looked up from its own folder.

    Raises:
        ConfigError: If the file cannot be used. One line names file, key, value and what is allowed.
    """
    file = find_resource(path)
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {_line(error)}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not a text file in UTF-8; allowed: a cell's YAML") from error
    return parse_config(text, path, file.absolute().parent, with_lines=True)


def parse_config(
    text: str, path: str | os.PathLike[str], folder: Path | None = None, *, with_lines: bool = False
) -> Config:
    """Check the YAML of a cell that was read from ``path``.

    Args:
        text: The YAML.
        path: The name of the file for messages.
        folder: Paths in the YAML are first looked up from this folder.
        with_lines: Whether messages have the number of the line, as for a file that the user has written.

    Raises:
        ConfigError: As in :func:`load_config`.
    """
    if text.lstrip().startswith("<"):
        raise ConfigError(f"{path}: is XML, such as a URDF; allowed: a cell's YAML; q2r2 new-cell makes one of a URDF")
    try:
        data = yaml.load(text, Loader=_Loader)
    # Values such as dates and huge integers, and too deep nesting, raise Python's own exceptions.
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        said = str(error).replace(' "<unicode string>",', "")  # PyYAML calls the text "<unicode string>".
        raise ConfigError(f"{path}: not YAML: {_line(said)}") from error
    if data is None:
        raise ConfigError(f"{path}: the file is empty; allowed: a cell's YAML; q2r2 new-cell makes one")
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping of keys such as name, arms, obstacles; got {data!r:.60}")

    def place(location: Sequence[int | str]) -> str:
        number = _line_number(text, location) if with_lines else None
        return f"{path}: " if number is None else f"{path}, line {number}: "

    try:
        # The check is strict, because `off` would otherwise count as 0.0. The data are checked as JSON, because even a
        # strict check of JSON accepts a list for a tuple, and a name for an enum.
        content = json.dumps(data, default=str)
        config = Config.__pydantic_validator__.validate_json(content, strict=True, context={"folder": folder})
        return _within_driver_limits(config)
    except ValidationError as error:
        raise config_error(error, Config, place) from error
    except ConfigError as error:
        raise error.at(f"{path}: ") from error
    except (ValueError, TypeError, RecursionError) as error:
        raise ConfigError(f"{path}: expected plain keys and values: {_line(error)}") from error


# Distance of the soft limits of a KUKA driver from the model's joint limits [rad]. The driver's joint limits are one
# degree inside the model's, and its soft limits are another 5 degrees inside. Beyond the driver's joint limits,
# lbr_fri_ros2_stack closes the connection, and a cabinet ends its session. The driver's safe_stop closes the connection
# even earlier, if one more step at a joint's greatest speed would leave its joint limits. If commands are due every
# 10 ms, this step is 1.8 degrees at most. This is less than the 5 degrees between soft limits and joint limits.
_DRIVER_MARGIN = 0.105
# Greatest share of a joint's velocity limit that the commands for a driver may reach. The driver also closes the
# connection if a joint is faster than its velocity limit. Commands come unevenly. If one command more than usual comes
# within a period of the driver, the output of the driver's filter is faster by the share h / T. T is the filter's time
# constant, and h is the time between commands. For h = 5 ms and T = 40 ms, the share h / T is an eighth. If a command
# is late by d, the share grows by (d / T)^2 / 2.
_DRIVER_SPEED = 0.85
# Greatest share of a joint's velocity limit that the commands for a cabinet may reach. While the times of answers catch
# up with a cabinet's clock, the cabinet sees up to 1.05 times the reference's speeds (plants.fri.answers).
_CABINET_SPEED = 0.95


def _within_driver_limits(config: Config) -> Config:
    """Return the cell with limits of joints that keep drivers and cabinets from ending the connection."""
    by_ros = config.external is not None and config.external.preset.startswith("lbr_")
    control = config.control
    if control.limits == "model" or not (by_ros or config.fri):
        return config
    fastest = _DRIVER_SPEED if by_ros else _CABINET_SPEED
    narrower = {
        "position_margin": max(control.position_margin, _DRIVER_MARGIN),
        "velocity_scale": min(control.velocity_scale, fastest),
    }
    return config.model_copy(update={"control": control.model_copy(update=narrower)})


def _line_number(text: str, location: Sequence[int | str]) -> int | None:
    """Return the number of the line of a key in a YAML, from 1 on.

    If the key is missing, return the line of the innermost block that should contain it; None if no such block exists.
    """
    node, line = yaml.compose(text, Loader=_Loader), None
    for part in location:
        if isinstance(node, yaml.MappingNode):
            # Two kinds of parts of ``location`` are not in the file: pydantic's tags of alternative models, and missing
            # keys. They change neither ``node`` nor ``line``.
            found = [(key, value) for key, value in node.value if key.value == str(part)]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            found = [(node.value[part], node.value[part])]
        else:
            break
        for key, value in found:
            line, node = key.start_mark.line + 1, value
    return line


class _Loader(SafeLoader):
    """A loader that is stricter than YAML 1.1: it refuses a key that is given twice, and reads 1e-3 as a number.

    In YAML 1.1, the second of two equal keys would silently replace the first one, and 1e-3 would be a text.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue  # With `<<: *other`, keys of the mapping itself are allowed to replace merged keys.
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is given twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+"), list("-+0123456789")
)


def _line(text: object) -> str:
    """Return ``text`` as one line of bounded length."""
    return " ".join(str(text).split())[:300]
