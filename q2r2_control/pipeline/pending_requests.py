"""Requests of a program to a running loop, and the events that record them, so that a replay can repeat them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason, ReasonKind


@dataclass(slots=True)
class PendingRequests:
    """Set from any thread; each is done once, at the next tick."""

    home: bool = False
    settings: TeleopSettings | None = None
    control: Mapping[str, float] | None = None  # of the controller, by name
    of_recording: list[Reason] = field(default_factory=list)  # verdicts on episodes, and why it ended

    def __bool__(self) -> bool:
        """Whether anything is asked for."""
        return self.home or self.settings is not None or self.control is not None or bool(self.of_recording)

    def clear(self) -> None:
        """Ask for nothing any more."""
        self.home, self.settings, self.control = False, None, None
        self.of_recording.clear()

    def reasons(self, current: TeleopSettings) -> Iterator[Reason]:
        """One for each request; settings by what is not as it is in the ``current`` ones."""
        if self.home:
            yield Reason(ReasonKind.HOME_REQUESTED)
        if self.settings is not None:
            changed = _difference(current.model_dump(mode="json"), self.settings.model_dump(mode="json"))
            yield Reason.of(ReasonKind.SETTINGS_REQUESTED, changes=changed)
        if self.control is not None:
            yield Reason.of(ReasonKind.CONTROL_REQUESTED, changes=dict(self.control))
        yield from self.of_recording

    def repeat(self, reason: Reason, current: TeleopSettings) -> None:
        """Request what a recorded ``reason`` says was requested. Raises ValueError for settings that are none."""
        if reason.kind is ReasonKind.HOME_REQUESTED:
            self.home = True
        elif reason.kind is ReasonKind.CONTROL_REQUESTED:
            self.control = reason.detail["changes"]
        elif reason.kind is ReasonKind.SETTINGS_REQUESTED:
            changed = _merged(current.model_dump(mode="json"), reason.detail["changes"])
            self.settings = TeleopSettings.model_validate(changed)
        elif reason.kind is ReasonKind.VERDICT and reason not in self.of_recording:
            self.of_recording.append(reason)


def _difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Values of ``new`` that differ from ``old``, also in mappings with the same keys."""
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
