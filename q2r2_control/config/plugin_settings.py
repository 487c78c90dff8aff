"""Check a cell's settings for inputs and plants of other packages.

The class of an input or a plant names the model of its settings by its attribute ``settings``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from q2r2_control.config.strict import validated
from q2r2_control.plugins import load_class, names_of


def check_block(key: str, name: str, found: Any, blocks: Mapping[str, object]) -> None:
    """Check the settings of one input or plant.

    Args:
        key: The key of all blocks in the cell, such as ``plant_settings``.
        name: The name of the block's input or plant.
        found: The class with this name. Its attribute ``settings`` is the :class:`StrictModel` of its block; without
            this attribute, every block is allowed.
        blocks: The blocks of all names. A missing block is allowed.

    Raises:
        ConfigError: If a value is not allowed. The message names the key.
    """
    if name in blocks and (model := getattr(found, "settings", None)) is not None:
        validated(model, f"{key}.{name}: ", blocks[name])


def check_blocks(group: str, key: str, blocks: Mapping[str, object]) -> list[str]:
    """Check all blocks of a ``group`` of entry points as :func:`check_block` does.

    Returns:
        A line for each block whose input or plant is not installed.

    Raises:
        ConfigError: If a value is not allowed, or if a class cannot be imported.
    """
    unknown = []
    for name in blocks:
        if name in names_of(group):
            check_block(key, name, load_class(group, name), blocks)
        else:
            kind = key.removesuffix("_settings")
            unknown.append(f"{key}.{name}: no installed {kind} has this name; installed: {', '.join(names_of(group))}")
    return unknown
