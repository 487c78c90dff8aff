"""Reads reasons and events in recordings, also those of packages that are not installed."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from functools import cache
from typing import Any

from q2r2_control.events import CommonReason, Event, is_kind
from q2r2_control.types import ActionChunk

_logger = logging.getLogger(__name__)


def event_of(data: Mapping[str, Any]) -> Event:
    """Make an event from recorded data; see :meth:`Event.from_json`.

    A kind of reason that no installed package has becomes :attr:`CommonReason.OTHER`. Its text is the kind and the
    details. A line in the log names each such kind once.

    Raises:
        ValueError, KeyError, TypeError: If the data are not those of an event.
    """
    return Event.from_json(_readable(data))


def chunk_of(data: Mapping[str, Any]) -> ActionChunk:
    """Make a chunk of actions from recorded data, whose fault is read like the reason of an event.

    Raises:
        ValueError, KeyError, TypeError: If the data are not those of a chunk.
    """
    fault = data["fault"]
    return ActionChunk.from_json(data if fault is None else {**data, "fault": _readable(fault)})


def _readable(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of a reason or an event, in which every kind is installed."""
    known = dict(data)
    if "cause" in known:
        known["cause"] = _readable(known["cause"])
    kind = known["kind"]
    if isinstance(kind, str) and not is_kind(kind):
        _tell_missing(kind)
        details = known.get("detail", {})
        known |= {"kind": str(CommonReason.OTHER), "detail": {"text": f"{kind} {json.dumps(details)}"}}
    return known


@cache
def _tell_missing(kind: str) -> None:
    """Log a line at the first call with ``kind``."""
    _logger.warning(
        "a recording has reasons of the kind %.60r, which no installed package has; "
        "to read their sentences, install the package that wrote the recording",
        kind,
    )
