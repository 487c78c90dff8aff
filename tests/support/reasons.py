"""Reasons of events as short texts of their kinds, so that tests do not depend on the sentences for operators."""

from __future__ import annotations

from q2r2_control.events import Reason


def kinds(reason: Reason | None) -> str:
    """Return the kinds of a reason and of its causes, such as ``not_engaged: pose_silent``; empty for None."""
    if reason is None:
        return ""
    return str(reason.kind) if reason.cause is None else f"{reason.kind}: {kinds(reason.cause)}"
