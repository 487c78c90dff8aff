"""What a program asks of a run that goes on, and how an event tells it, so that a replay can ask the same."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from q2r2_control.config.teleop import TeleopSettings

_HOME = "a program asks for the way home"
_CHANGE = "a program changes settings: "


@dataclass(slots=True)
class Wishes:
    """Set from any thread; each is done once, at the next tick."""

    home: bool = False
    settings: TeleopSettings | None = None

    def clear(self) -> None:
        """Ask for nothing any more."""
        self.home, self.settings = False, None

    def told(self, current: TeleopSettings) -> Iterator[str]:
        """A line for each wish; settings by what is not as it is in the ``current`` ones."""
        if self.home:
            yield _HOME
        if self.settings is not None:
            changed = _difference(current.model_dump(mode="json"), self.settings.model_dump(mode="json"))
            yield _CHANGE + json.dumps(changed)

    def take(self, line: str, current: TeleopSettings) -> None:
        """Wish what such a line tells; any other is none. Raises :class:`ValueError` for settings that are none."""
        if line == _HOME:
            self.home = True
        elif line.startswith(_CHANGE):
            changed = json.loads(line.removeprefix(_CHANGE))
            self.settings = TeleopSettings.model_validate(_merged(current.model_dump(mode="json"), changed))


def _difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """What of ``new`` is not as in ``old``; mappings with the same keys are gone into."""
    found: dict[str, Any] = {}
    for name, value in new.items():
        before = old.get(name)
        if value == before:
            continue
        same = isinstance(value, dict) and isinstance(before, dict) and value.keys() == before.keys()
        found[name] = _difference(before, value) if same and isinstance(before, dict) else value
    return found


def _merged(old: Mapping[str, Any], changed: Mapping[str, Any]) -> dict[str, Any]:
    inner = {
        name: _merged(old[name], value)
        if isinstance(value, dict) and isinstance(old.get(name), dict) and value.keys() <= old[name].keys()
        else value
        for name, value in changed.items()
    }
    return {**old, **inner}
