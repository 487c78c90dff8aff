"""What an operator says of the recording: where an episode begins and ends, what became of it, and marks."""

from __future__ import annotations

from q2r2_control.config.bindings import Action

BEGINS, ENDS, DISCARDED, MARK = "episode begins", "episode ends", "episode discarded", "mark"
SUCCEEDED, FAILED = "episode succeeded", "episode failed"
VERDICT = "verdict on episode "  # with its number, and a line of what is to become of it
RECORDING_ENDED = "not recorded any more: "  # and why
NO_RECORDING = "not recorded: this run has no recording"
_OUTCOMES = {Action.RECORD_SUCCESS: SUCCEEDED, Action.RECORD_FAILURE: FAILED}
_NONE_YET = "not discarded: no episode has begun"


def verdict_line(number: int, line: str) -> str:
    """What tells the verdict on an episode; ``line`` begins with ``keep`` or ``discard``."""
    return f"{VERDICT}{number}: {line}"


def is_kept(reason: str) -> bool | None:
    """Of an event's reason: whether it tells that an episode is kept, or is not; None: it tells no such thing."""
    if not reason.startswith(VERDICT):
        return None
    word = reason.removeprefix(VERDICT).partition(": ")[2]
    return True if word.startswith("keep") else False if word.startswith("discard") else None


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

    def take(self, action: Action) -> str:
        """Follow a control; returns the event's reason. What became of an episode ends it."""
        if not self.recorded:
            return NO_RECORDING
        if action is Action.RECORD_MARK:
            return MARK
        if action is Action.RECORD_DISCARD:
            self.open = False
            any_episode, self.any = self.any, False
            return DISCARDED if any_episode else _NONE_YET
        if action in _OUTCOMES:
            self.open = False
            return _OUTCOMES[action]
        self.open = not self.open
        self.any = True
        return BEGINS if self.open else ENDS

    def follow(self, reason: str) -> None:
        """Learn of an event that was told elsewhere, by its ``reason``."""
        if reason in (SUCCEEDED, FAILED):
            self.open = False
        elif reason in (BEGINS, ENDS, DISCARDED):
            self.open, self.any = reason == BEGINS, reason != DISCARDED
