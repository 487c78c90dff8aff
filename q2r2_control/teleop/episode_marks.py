"""What an operator says of the recording: where an episode begins and ends, what became of it, and marks."""

from __future__ import annotations

from q2r2_control.config.bindings import Action
from q2r2_control.events import ReasonKind

_OUTCOMES = {
    Action.RECORD_SUCCESS: ReasonKind.EPISODE_SUCCEEDED,
    Action.RECORD_FAILURE: ReasonKind.EPISODE_FAILED,
}


class EpisodeMarks:
    """Turns the controls of the recording into events, which are in the recording as all events are."""

    actions = (
        Action.RECORD_DISCARD,
        Action.RECORD_FAILURE,
        Action.RECORD_SUCCESS,
        Action.RECORD_TOGGLE,
        Action.RECORD_MARK,
    )

    def __init__(self) -> None:
        self.recorded = False  # whether there is a recording
        self.open = False  # whether an episode has begun and not ended
        self.any = False  # whether there is an episode that could be discarded

    def apply(self, action: Action) -> ReasonKind:
        """Follow a control; returns the event's kind. What became of an episode ends it."""
        if not self.recorded:
            return ReasonKind.NO_RECORDING
        if action is Action.RECORD_MARK:
            return ReasonKind.MARK
        if action is Action.RECORD_DISCARD:
            self.open = False
            any_episode, self.any = self.any, False
            return ReasonKind.EPISODE_DISCARDED if any_episode else ReasonKind.NO_EPISODE
        if action in _OUTCOMES:
            self.open = False
            return _OUTCOMES[action]
        self.open = not self.open
        self.any = True
        return ReasonKind.EPISODE_BEGINS if self.open else ReasonKind.EPISODE_ENDS

    def follow(self, kind: ReasonKind) -> None:
        """Follow an event that happened elsewhere."""
        if kind in _OUTCOMES.values():
            self.open = False
        elif kind in (ReasonKind.EPISODE_BEGINS, ReasonKind.EPISODE_ENDS, ReasonKind.EPISODE_DISCARDED):
            self.open, self.any = kind is ReasonKind.EPISODE_BEGINS, kind is not ReasonKind.EPISODE_DISCARDED
