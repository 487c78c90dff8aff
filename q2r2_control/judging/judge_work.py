"""What the process beside the loop does that judges episodes while the run goes on: one after the other, as asked.

It reads what the recorder has written by then, so it waits until an episode is in the file as a whole.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.errors import Q2R2Error, RecordingError
from q2r2_control.judging.episode import Episode, read_episode
from q2r2_control.judging.judge import judge_episode
from q2r2_control.judging.parts import part_of, parts_of
from q2r2_control.recording.episode_spans import EpisodeSpan
from q2r2_control.recording.helper import be_nice, has_ended, reason_of
from q2r2_control.recording.ros_recording import open_recording

LONGEST_LINE = 300  # of a verdict [characters]
LONGEST_MESSAGE = 4096  # that a pipe takes at once [bytes]
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


def main(asked: int, answered: int, parent: int) -> None:
    """Answer each line that is a question, read from ``asked``, by one on ``answered``, until the run has ended."""
    be_nice(_NICENESS)
    for question in _questions(asked, parent):
        try:
            answer = _answer(question, parent)
        except (Q2R2Error, OSError) as error:
            answer = _not_judged(question, reason_of(error))
        os.write(answered, json.dumps(vars(answer)).encode() + b"\n")


def _questions(asked: int, parent: int) -> Iterator[Question]:
    rest = b""
    while not has_ended(parent, 0.0):
        if asked not in select.select([asked, sys.stdin], [], [], 1.0)[0]:
            continue
        data = os.read(asked, LONGEST_MESSAGE)
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            yield Question(**json.loads(line))


def _answer(question: Question, parent: int) -> Answer:
    until = time.monotonic() + _PATIENCE
    problem = f"it was not written within {_PATIENCE:g} s"
    while time.monotonic() < until:
        try:
            if (episode := written_episode(question)) is not None:
                verdict = judge_episode(episode).verdict
                return Answer(question.number, verdict.keep, verdict.line[:LONGEST_LINE])
        except RecordingError as error:  # of a file whose beginning is not written yet, too
            problem = str(error)
        if has_ended(parent, _LOOKS):
            problem = "the run has ended"
            break
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
