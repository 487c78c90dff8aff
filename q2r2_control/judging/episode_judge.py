"""Judge each episode of a recording as soon as it has ended, while the run goes on."""

from __future__ import annotations

import logging
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.errors import Q2R2Error, RecordingError
from q2r2_control.events import Event, Reason
from q2r2_control.judging.episode import Episode, read_episode
from q2r2_control.judging.judge import judge_episode, part_of, parts_of
from q2r2_control.process.helper_process import HelperProcess, reason_of
from q2r2_control.recording.reader import EpisodeSpan, spans_of
from q2r2_control.recording.ros_recording import open_recording
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.wording import sentence

LONGEST_LINE = 300  # The longest text of a verdict [characters].
_NICENESS = 10  # The niceness of this process, and of the process that writes. The loop has a higher priority.
_LOOKS = 0.3  # Time between two attempts to read the episode from the file, which grows twice a second [s].
_PATIENCE = 30.0  # Longest time to wait until the recorder has written the episode [s].
_BEFORE = 1_000_000_000  # Reading begins this long before the episode [ns].
_TICKS_BETWEEN_LOOKS = 64  # The number of ticks between two checks for a verdict.
_OF_EPISODES = {
    *(TeleopReason.EPISODE_BEGINS, TeleopReason.EPISODE_ENDS, TeleopReason.EPISODE_DISCARDED),
    *(TeleopReason.EPISODE_SUCCEEDED, TeleopReason.EPISODE_FAILED, TeleopReason.SUBTASK_BEGINS),
}

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Question:
    """An episode of a ``file``, which has to be judged.

    If ``timed`` is True, the times of ``span`` have the same clock as the ticks in the file. Otherwise the episode is
    found by its number.
    """

    file: str
    span: EpisodeSpan
    timed: bool


def main(requests: Iterator[Question], answer: Callable[[Reason], None]) -> None:
    """Answer each question with the verdict on its episode."""
    run = os.getppid()
    with suppress(OSError):
        os.nice(_NICENESS)
    for question in requests:
        try:
            keep, line = _verdict(question, run)
        except (Q2R2Error, OSError) as error:
            keep, line = None, f"not judged: {reason_of(error)}"
        number = question.span.number
        answer(Reason.of(TeleopReason.VERDICT, episode=number, keep=keep, line=line[:LONGEST_LINE]))


def _verdict(question: Question, run: int) -> tuple[bool | None, str]:
    """Wait until the episode is written. Return True to keep it or False to discard it, and the verdict in one line.

    The first value is None if the episode was not written in time. ``run`` is the id of the process that asks. If that
    process ends, the waiting ends too.
    """
    until = time.monotonic() + _PATIENCE
    problem = f"it was not written within {_PATIENCE:g} s"
    while time.monotonic() < until and os.getppid() == run:
        try:
            if (episode := written_episode(question)) is not None:
                verdict = judge_episode(episode).verdict
                return verdict.keep, verdict.line
        except RecordingError as error:  # Perhaps the beginning of the file is not written yet.
            problem = str(error)
        time.sleep(_LOOKS)
    return None, f"not judged: {problem}"


def written_episode(question: Question) -> Episode | None:
    """Return the episode; None if the file does not have all of it yet.

    The episode has no pictures, because they may be written seconds later.
    """
    recording, span = open_recording(Path(question.file)), question.span
    if not question.timed:
        found = parts_of(read_episode(recording, pictures=False))[span.number - 1 : span.number]
        return found[0] if found and found[0].ended_by_operator else None
    recording.since = recording.about.epoch + round(span.start * 1e9) - _BEFORE  # Earlier data is not needed.
    whole = read_episode(recording, pictures=False)
    return part_of(whole, span) if len(whole.ticks.t) and whole.ticks.t[-1] > span.end else None


class EpisodeJudge:
    """Judges the episodes of a recorded run, in a process of low priority.

    It is a listener of the run's pipeline, and a context manager around the run. It raises nothing: a failure is logged
    once. A caller that has no ticks calls :meth:`record_event` and :meth:`report_verdicts` itself.
    """

    def __init__(
        self, file: Callable[[], Path | None], report: Callable[[Reason], None], *, timed: bool = True
    ) -> None:
        """Prepare to judge the episodes in a file that is being written.

        Args:
            file: Returns the path of the file, or None if there is no file.
            report: Called with each verdict.
            timed: True if events have the same clock as the ticks in the file. Then only the episode's ticks are read.
        """
        self._file, self._report, self._timed = file, report, timed
        self._events: list[Event] = []
        self._asked: Question | None = None
        self._count = 0
        self._answers: deque[Reason] = deque()
        self._process: HelperProcess | None = None
        self._started = False

    def start(self) -> None:
        """Start the process, which takes some milliseconds. Without this call, the first question starts it."""
        self._started = True
        try:
            work = "q2r2_control.judging.episode_judge"
            self._process = HelperProcess("judges episodes", work, self._answers.append)
        except OSError as error:
            self._fail(reason_of(error))

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    def __call__(self, tick: Tick) -> None:
        """Take one tick. It never raises an error and never waits."""
        for event in tick.events:
            self.record_event(event)
        self._count += 1
        if self._count % _TICKS_BETWEEN_LOOKS == 0:
            self.report_verdicts()

    def record_event(self, event: Event) -> None:
        """Take an event. If it ends an episode, ask the process for a verdict."""
        if event.kind not in _OF_EPISODES:
            return
        self._events.append(event)
        last, file = spans_of(self._events)[-1], self._file()
        if last.number == 0 or last.end == math.inf or last.discarded or file is None:
            return
        if not self._started:
            self.start()
        question = Question(str(file.absolute()), last, self._timed)
        if question != self._asked and self._process is not None:
            self._process.send(question)
        self._asked = question

    def report_verdicts(self) -> None:
        while self._answers:
            verdict = self._answers.popleft()
            if spans_of(self._events)[verdict.detail["episode"] - 1].discarded:
                continue  # The operator discarded the episode before the verdict came.
            _logger.info(sentence(verdict))
            self._report(verdict)
        if self._process is not None and self._process.fault is not None:
            self._fail(self._process.fault)

    def close(self) -> None:
        """Kill the process, which is not started again."""
        self._started = True
        if self._process is not None:
            self._process.kill()
            self._process = None

    def __enter__(self) -> EpisodeJudge:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fail(self, reason: str) -> None:
        _logger.warning("episodes are not judged before the run ends: %s", reason)
        self._process = None
