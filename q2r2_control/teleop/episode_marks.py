"""What an operator says of the recording: where an episode begins and ends, whether it is worth keeping, and marks."""

from __future__ import annotations

from q2r2_control.config.bindings import Action

BEGINS, ENDS, DISCARDED, MARK = "episode begins", "episode ends", "episode discarded", "mark"
NO_RECORDING = "not recorded: this run has no recording"
_NONE_YET = "not discarded: no episode has begun"


class EpisodeMarks:
    """Turns the controls of the recording into events, which are in the recording as all events are."""

    actions = (Action.RECORD_DISCARD, Action.RECORD_TOGGLE, Action.RECORD_MARK)

    def __init__(self) -> None:
        self.recorded = False  # whether there is a recording
        self.open = False  # whether an episode has begun and not ended
        self._any = False

    def take(self, action: Action) -> str:
        """Follow a control; returns the event's reason. A discard ends an episode that has not ended."""
        if not self.recorded:
            return NO_RECORDING
        if action is Action.RECORD_MARK:
            return MARK
        if action is Action.RECORD_DISCARD:
            self.open = False
            any_episode, self._any = self._any, False
            return DISCARDED if any_episode else _NONE_YET
        self.open = not self.open
        self._any = True
        return BEGINS if self.open else ENDS
