"""Make sentences for people from events and reasons. No code makes decisions from these sentences."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from q2r2_control.device_words import DeviceWords
from q2r2_control.events import Event, Reason
from q2r2_control.types import ActiveLimit, LimitKind

_LIMITS = {
    LimitKind.POSITION: "position",
    LimitKind.VELOCITY: "velocity",
    LimitKind.ACCELERATION: "acceleration",
    LimitKind.CONSTRAINT: "constraint",
    LimitKind.TOOL_SPEED: "tool speed",
}


def sentence(reason: Reason, words: DeviceWords | None = None) -> str:
    """Return the sentence of ``reason``. With ``words``, controls have the names of that device's operator."""
    fields: dict[str, Any] = {name: _text(value) for name, value in reason.detail.items()}
    if words is not None and (control := reason.detail.get("control")) is not None:
        fields["control"] = words.noun(control)
    if words is not None and (controls := reason.detail.get("controls")) is not None:
        fields["controls"] = _text([*map(words.noun, controls)])
    if reason.cause is not None:
        fields["cause"] = sentence(reason.cause, words)
    return reason.kind.template.format(**fields)


def _text(value: Any) -> Any:
    """Return a list as text ("a and b"), a mapping as JSON, and other values unchanged. The template formats them."""
    if isinstance(value, Mapping):
        return json.dumps(value)
    return " and ".join(map(str, value)) if isinstance(value, list | tuple) else value


def event_line(event: Event) -> str:
    """Return one line with the new state of an arm and the reason."""
    return f"{event.destination}: {sentence(event.reason)}"


def limit_name(limit: ActiveLimit) -> str:
    """Return the name of a limit that held a step back, such as ``left_A2 velocity`` or ``left_link_5|table``."""
    if limit.kind is LimitKind.SEPARATION:
        return "|".join(limit.names)
    return f"{limit.names[0]} {_LIMITS[limit.kind]}"
