"""The line that tells which episode and which subtask is recorded."""

from __future__ import annotations

import pytest

from q2r2_control.events import Event, Reason
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.viewer.episode_words import EpisodeWords

SECOND = Reason.of(TeleopReason.SUBTASK_BEGINS, number=2, name="grasp")
BEGINS, ENDS, DISCARDED = (
    Reason(TeleopReason.EPISODE_BEGINS),
    Reason(TeleopReason.EPISODE_ENDS),
    Reason(TeleopReason.EPISODE_DISCARDED),
)


@pytest.mark.parametrize(
    ("names", "told", "text"),
    [
        ((), [], "records this run as one episode"),
        ((), [BEGINS], "records episode 1"),
        ((), [BEGINS, ENDS], "records; 1 episode so far"),
        (("reach", "grasp"), [], "records, subtask 1: reach"),
        (("reach", "grasp"), [SECOND], "records, subtask 2: grasp"),
        (("reach", "grasp"), [BEGINS, SECOND], "records episode 1, subtask 2: grasp"),
        (("reach", "grasp"), [BEGINS, SECOND, ENDS, BEGINS], "records episode 2, subtask 1: reach"),
        (("reach", "grasp"), [BEGINS, SECOND, DISCARDED], "records; 1 episode so far"),
        ((), [BEGINS, SECOND], "records episode 1, subtask 2"),
    ],
)
def test_the_line_about_a_recording_shows_the_episode_and_the_subtask_after_each_event(
    names: tuple[str, ...], told: list[Reason], text: str
) -> None:
    words = EpisodeWords(names)
    words.follow(Event(0.0, "left", "paused", "paused", reason) for reason in told)
    assert words.text == text
