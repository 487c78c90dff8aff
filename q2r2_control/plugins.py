"""Find inputs, plants, presets, formats of exports and kinds of reasons by name.

They are entry points of any installed package:

[project.entry-points."q2r2_control.inputs"]
gamepad = "my_package.gamepad:Gamepad"
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from q2r2_control.errors import ConfigError

INPUTS = "q2r2_control.inputs"
PLANTS = "q2r2_control.plants"
PRESETS = "q2r2_control.presets"
EXPORTS = "q2r2_control.exports"
REASONS = "q2r2_control.reasons"


def names_of(group: str) -> tuple[str, ...]:
    """Return the names that installed packages declare, in alphabetical order."""
    return tuple(sorted({point.name for point in entry_points(group=group)}))


def load_class(group: str, name: str) -> Any:
    """Return the class, the preset or the format called ``name``.

    Raises:
        ConfigError: If there is no such name, or if it cannot be imported.
    """
    found = {point.name: point for point in sorted(entry_points(group=group), key=lambda point: point.name)}
    if name not in found:
        kind = group.rpartition(".")[2].removesuffix("s")
        raise ConfigError(f"{kind} {name!r:.60}: allowed are {', '.join(found)}; installed as entry points {group}")
    try:
        return found[name].load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{group}: {name} = {found[name].value}: {error}") from error
