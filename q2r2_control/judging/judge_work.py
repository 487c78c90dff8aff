"""What the process beside the loop does that judges episodes while the run goes on: one after the other, as asked.

It reads what the recorder has written by then, so it waits until an episode is in the file as a whole.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.errors import Q2R2Error, RecordingError
from q2r2_control.judging.episode import Episode, read_episode
from q2r2_control.judging.judge import judge_episode
from q2r2_control.judging.parts import part_of, parts_of
from q2r2_control.recording.episode_spans import EpisodeSpan
from q2r2_control.recording.helper_process import reason_of
from q2r2_control.recording.ros_recording import open_recording

LONGEST_LINE = 300  # of a verdict [characters]
_NICENESS = 10  # as the writer: the loop goes first
_LOOKS = 0.3  # between two looks at the file, which grows twice a second [s]
_PATIENCE = 30.0  # with a recorder that is behind [s]
_BEFORE = 1_000_000_000  # of the beginning, where reading begins [ns]


@dataclass(frozen=True)
class Question:
    """Which episode is to be judged."""

    file: str
    number: int  # of the episode, from 1 on
    # Since the run began [s], so that no more has to be read. None: known to the file alone.
    start: float | None = None
    end: float | None = None
    success: bool | None = None


@dataclass(frozen=True)
class Answer:
    """What became of it."""

    number: int
    keep: bool | None  # None: it could not be judged
    line: str  # keep, discard and why, or why it could not be judged


def main(requests: Iterator[Question], answer: Callable[[Answer], None]) -> None:
    """Answer each question with the verdict on its episode."""
    run = os.getppid()
    with suppress(OSError):
        os.nice(_NICENESS)
    for question in requests:
        try:
            found = _answer(question, run)
        except (Q2R2Error, OSError) as error:
            found = _not_judged(question, reason_of(error))
        answer(found)


def _answer(question: Question, run: int) -> Answer:
    """``run``: the process that asks, as long as there is somebody to answer."""
    until = time.monotonic() + _PATIENCE
    problem = f"it was not written within {_PATIENCE:g} s"
    while time.monotonic() < until and os.getppid() == run:
        try:
            if (episode := written_episode(question)) is not None:
                verdict = judge_episode(episode).verdict
                return Answer(question.number, verdict.keep, verdict.line[:LONGEST_LINE])
        except RecordingError as error:  # of a file whose beginning is not written yet, too
            problem = str(error)
        time.sleep(_LOOKS)
    return _not_judged(question, problem)


def _not_judged(question: Question, problem: str) -> Answer:
    return Answer(question.number, None, f"not judged: {problem}"[:LONGEST_LINE])


def written_episode(question: Question) -> Episode | None:
    """The episode; None where it is not in the file as a whole yet."""
    recording = open_recording(Path(question.file))
    if question.start is None or question.end is None:
        parts = parts_of(read_episode(recording))
        found = parts[question.number - 1] if len(parts) >= question.number else None
        return found if found is not None and found.ended_by_operator else None
    recording.since = recording.about.epoch + round(question.start * 1e9) - _BEFORE
    whole = read_episode(recording)
    if not len(whole.ticks.t) or whole.ticks.t[-1] <= question.end:
        return None
    return part_of(whole, EpisodeSpan(question.start, question.end, success=question.success), question.number)
