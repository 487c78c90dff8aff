"""Tell people which episode and which subtask is recorded now."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from q2r2_control.config.recording import subtask_name
from q2r2_control.events import Event
from q2r2_control.teleop.reasons import TeleopReason

_EPISODE_OVER = (
    TeleopReason.EPISODE_ENDS,
    TeleopReason.EPISODE_SUCCEEDED,
    TeleopReason.EPISODE_FAILED,
    TeleopReason.EPISODE_DISCARDED,
)


class EpisodeWords:
    """Makes a line of text about the present episode from the events of a recorded run.

    If no episode begins in a run, the whole run is one episode.
    """

    def __init__(self, subtasks: Sequence[str]) -> None:
        """``subtasks`` are the names of an episode's subtasks, in their order; empty if they have no names."""
        self._names, self._shows_subtask = subtasks, bool(subtasks)
        self._episodes, self._open, self._subtask = 0, False, 1

    def follow(self, events: Iterable[Event]) -> None:
        for event in events:
            if event.kind is TeleopReason.EPISODE_BEGINS:
                self._episodes, self._open, self._subtask = self._episodes + (not self._open), True, 1
            elif event.kind in _EPISODE_OVER:
                self._open = False
            elif event.kind is TeleopReason.SUBTASK_BEGINS:
                self._subtask, self._shows_subtask = event.reason.detail["number"], True

    @property
    def text(self) -> str:
        count = f"{self._episodes} episode{'' if self._episodes == 1 else 's'}"
        episode = f"records episode {self._episodes}" if self._open else f"records; {count} so far"
        if not self._episodes:
            episode = "records this run as one episode"
        if not self._shows_subtask or not (self._open or not self._episodes):
            return episode
        name = subtask_name(self._names, self._subtask)
        number = "" if self._subtask > len(self._names) else f"subtask {self._subtask}: "
        return f"{episode if self._episodes else 'records'}, {number}{name}"
