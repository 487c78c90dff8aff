"""The settings of an input, which are in the cell's YAML under ``input_settings``."""

from __future__ import annotations

from typing import TypeVar

from q2r2_control import Config, ConfigError, StrictModel

Settings = TypeVar("Settings", bound=StrictModel)


def settings_of(config: Config, name: str, kind: type[Settings]) -> Settings:
    """Return the checked settings ``input_settings.name`` of a cell.

    Raises:
        ConfigError: If a key is missing or a value is not allowed.
    """
    try:
        return kind.model_validate(config.input_settings.get(name, {}))
    except ConfigError as error:
        raise error.at(f"input_settings.{name}: ") from error
