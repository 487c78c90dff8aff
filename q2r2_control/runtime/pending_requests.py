"""What a program asks of a run that goes on, and how an event tells it, so that a replay can ask the same."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.teleop.episode_marks import VERDICT

_HOME = "a program asks for the way home"
_CHANGE = "a program changes settings: "
_CONTROL = "a program changes control: "


@dataclass(slots=True)
class PendingRequests:
    """Set from any thread; each is done once, at the next tick."""

    home: bool = False
    settings: TeleopSettings | None = None
    control: Mapping[str, float] | None = None  # of the controller, by name
    told_of_recording: list[str] = field(default_factory=list)  # verdicts on episodes, and why it ended

    def __bool__(self) -> bool:
        """Whether anything is asked for."""
        return self.home or self.settings is not None or self.control is not None or bool(self.told_of_recording)

    def clear(self) -> None:
        """Ask for nothing any more."""
        self.home, self.settings, self.control = False, None, None
        self.told_of_recording.clear()

    def told(self, current: TeleopSettings) -> Iterator[str]:
        """A line for each wish; settings by what is not as it is in the ``current`` ones."""
        if self.home:
            yield _HOME
        if self.settings is not None:
            changed = _difference(current.model_dump(mode="json"), self.settings.model_dump(mode="json"))
            yield _CHANGE + json.dumps(changed)
        if self.control is not None:
            yield _CONTROL + json.dumps(dict(self.control))
        yield from self.told_of_recording

    def take(self, line: str, current: TeleopSettings) -> None:
        """Wish what such a line tells; any other is none. Raises :class:`ValueError` for settings that are none."""
        if line == _HOME:
            self.home = True
        elif line.startswith(_CONTROL):
            self.control = json.loads(line.removeprefix(_CONTROL))
        elif line.startswith(_CHANGE):
            changed = json.loads(line.removeprefix(_CHANGE))
            self.settings = TeleopSettings.model_validate(_merged(current.model_dump(mode="json"), changed))
        elif line.startswith(VERDICT) and line not in self.told_of_recording:
            self.told_of_recording.append(line)


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
