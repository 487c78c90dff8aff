"""Where episodes begin and end in a recording: at its operator's controls, or else it is one as a whole."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from q2r2_control.errors import RecordingError
from q2r2_control.events import Event, ReasonKind
from q2r2_control.recording.about import LOOP
from q2r2_control.recording.reader import Recording
from q2r2_control.teleop.both_arms import EpisodeMarks


@dataclass(frozen=True)
class EpisodeSpan:
    """An episode within a run; times are since the run began [s]."""

    start: float = -math.inf
    end: float = math.inf  # inf: the run's
    discarded: bool = False  # by its operator
    success: bool | None = None  # None: nobody said
    number: int = 0  # from 1 on; 0: the whole run


WHOLE = EpisodeSpan()


def spans_of(events: Iterable[Event], run_succeeded: bool | None = None) -> list[EpisodeSpan]:
    """The episodes that an operator has told; the whole run where that are none.

    A discard, a success and a failure are for the episode that goes on, or else for the last one; what was said last
    counts. Of the whole run they are what the operator said, or else ``run_succeeded``, what the task's own check did.
    """
    whole = replace(WHOLE, success=run_succeeded)
    spans: list[EpisodeSpan] = []
    for event in events:
        is_open = bool(spans) and spans[-1].end == math.inf
        if event.kind is ReasonKind.EPISODE_BEGINS and not is_open:
            spans.append(EpisodeSpan(event.t))
        elif event.kind is ReasonKind.EPISODE_ENDS and is_open:
            spans[-1] = replace(spans[-1], end=event.t)
        elif event.kind is ReasonKind.EPISODE_DISCARDED and spans:
            spans[-1] = replace(spans[-1], end=min(spans[-1].end, event.t), discarded=True)
        elif event.kind in (ReasonKind.EPISODE_SUCCEEDED, ReasonKind.EPISODE_FAILED):
            success = event.kind is ReasonKind.EPISODE_SUCCEEDED
            if spans:
                spans[-1] = replace(spans[-1], end=min(spans[-1].end, event.t), success=success)
            else:
                whole = replace(whole, success=success)
    return [replace(span, number=number) for number, span in enumerate(spans, 1)] or [whole]


def read_spans(recording: Recording) -> list[EpisodeSpan]:
    """The episodes of a recording. Raises :class:`RecordingError` for a damaged one."""
    about, success = recording.about, recording.conclusion.success
    if about.source == LOOP and not any(action in about.cell for action in EpisodeMarks.actions):
        return spans_of((), success)  # without reading all of it; of nodes, a service tells episodes too
    try:
        told = (events for chunk in recording.chunks() for events in chunk.events().values())
        return spans_of((event for events in told for event in events), success)
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{recording.file}: damaged: {error!r:.200}") from error
