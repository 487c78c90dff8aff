"""Verdicts on episodes of a recording, as soon as each has ended: whoever makes data learns of a bad one at once."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from types import TracebackType

from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.judging.judge_work import LONGEST_MESSAGE, Answer, Question
from q2r2_control.recording.episode_spans import spans_of
from q2r2_control.recording.helper import reason_of
from q2r2_control.recording.helper_process import HelperProcess
from q2r2_control.summary.tick import Tick
from q2r2_control.wording import sentence

_OF_EPISODES = {
    *(ReasonKind.EPISODE_BEGINS, ReasonKind.EPISODE_ENDS, ReasonKind.EPISODE_DISCARDED),
    *(ReasonKind.EPISODE_SUCCEEDED, ReasonKind.EPISODE_FAILED),
}
_LOOKS = 64  # ticks between two looks at whether a verdict is there

_logger = logging.getLogger(__name__)


class EpisodeJudge:
    """A listener of a recorded run, as a context around it; for others :meth:`note` and :meth:`look`.

    The work is done by a process of low priority. It raises nothing: what fails is logged once.
    """

    def __init__(self, file: Callable[[], Path | None], tell: Callable[[Reason], None], *, timed: bool = True) -> None:
        """``file``: what is recorded to; ``tell``: is given each verdict.

        ``timed``: times of events are those of ticks in the file, so only those of an episode have to be read.
        """
        self._file, self._tell, self._timed = file, tell, timed
        self._events: list[Event] = []
        self._asked: Question | None = None
        self._count, self._rest = 0, b""
        self._process: HelperProcess | None = None
        self._started = False
        self._questions = self._answers = -1

    def start(self) -> None:
        """Start the process, which takes some milliseconds, unless the first question shall."""
        self._started = True
        asked, self._questions = os.pipe()
        self._answers, answered = os.pipe()
        for end in (self._questions, self._answers):
            os.set_blocking(end, False)
        try:
            work = "q2r2_control.judging.judge_work"
            self._process = HelperProcess("judges episodes", work, (asked, answered), lambda: (0,))
        except OSError as error:
            self._fail(reason_of(error))
        finally:
            os.close(asked)
            os.close(answered)

    @property
    def pid(self) -> int | None:
        """Number of its process; None where that has ended."""
        return None if self._process is None else self._process.pid

    def __call__(self, tick: Tick) -> None:
        """Take one tick; never raises, and waits for nothing."""
        for event in tick.events:
            self.note(event)
        self._count += 1
        if self._count % _LOOKS == 0:
            self.look()

    def note(self, event: Event) -> None:
        """Learn of an event; one that ends an episode asks for the verdict on it."""
        if event.kind not in _OF_EPISODES:
            return
        self._events.append(event)
        number, last = len(spans := spans_of(self._events)), spans[-1]
        file = self._file()
        if last.whole or last.end == math.inf or last.discarded or file is None:
            return
        if not self._started:
            self.start()
        start, end = (last.start, last.end) if self._timed else (None, None)
        question = Question(str(file.absolute()), number, start, end, last.success)
        if question == self._asked:
            return
        self._asked = question
        if self._process is None:
            return
        try:
            os.write(self._questions, json.dumps(asdict(question)).encode() + b"\n")
        except OSError as error:
            self._fail(reason_of(error))

    def look(self) -> None:
        """Tell the verdicts that are there."""
        if self._process is None:
            return
        with suppress(BlockingIOError):
            self._rest += os.read(self._answers, LONGEST_MESSAGE)
        *lines, self._rest = self._rest.split(b"\n")
        for answer in (Answer(**json.loads(line)) for line in lines):
            if spans_of(self._events)[answer.number - 1].discarded:
                continue  # its operator has been faster
            verdict = Reason.of(ReasonKind.VERDICT, episode=answer.number, keep=answer.keep, line=answer.line)
            _logger.info(sentence(verdict))
            self._tell(verdict)
        if fault := self._process.fault():
            self._fail(fault)

    def close(self) -> None:
        """End the process, whatever it does; it is not started any more."""
        self._started = True
        if self._process is not None:
            self._process.end()
            self._process = None
        for end in (self._questions, self._answers):
            if end >= 0:
                os.close(end)
        self._questions = self._answers = -1

    def __enter__(self) -> EpisodeJudge:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _fail(self, reason: str) -> None:
        _logger.warning("episodes are not judged before the run ends: %s", reason)
        if self._process is not None:
            self._process.end()
            self._process = None
