"""Episodes that an operator tells of in a recording: where they begin and end, and which are worth keeping."""

from __future__ import annotations

import math

import pytest

from q2r2_control.events import Event, Reason
from q2r2_control.events import ReasonKind as K
from q2r2_control.recording.episode_spans import spans_of

BEGINS, ENDS, DISCARDED = K.EPISODE_BEGINS, K.EPISODE_ENDS, K.EPISODE_DISCARDED
SUCCEEDED, FAILED = K.EPISODE_SUCCEEDED, K.EPISODE_FAILED

CASES = {
    "none at all: the whole run": ([], [(-math.inf, math.inf, False)]),
    "two, one after the other": (
        [(1.0, BEGINS), (2.0, ENDS), (3.0, BEGINS), (4.0, ENDS)],
        [(1.0, 2.0, False), (3.0, 4.0, False)],
    ),
    "one that the run ends": ([(1.0, BEGINS)], [(1.0, math.inf, False)]),
    "one that is discarded while it goes on": ([(1.0, BEGINS), (2.0, DISCARDED)], [(1.0, 2.0, True)]),
    "one that is discarded after it has ended": (
        [(1.0, BEGINS), (2.0, ENDS), (2.5, DISCARDED), (3.0, BEGINS), (4.0, ENDS)],
        [(1.0, 2.0, True), (3.0, 4.0, False)],
    ),
    "other events": ([(0.5, K.MARK), (1.0, BEGINS), (1.5, K.POSE_SILENT)], [(1.0, math.inf, False)]),
}


def events(*told: tuple[float, K]) -> list[Event]:
    return [Event(t, "left", "engaged", "engaged", Reason(kind)) for t, kind in told]


@pytest.mark.parametrize(("told", "expected"), CASES.values(), ids=CASES)
def test_episodes_are_where_the_operator_says(
    told: list[tuple[float, K]], expected: list[tuple[float, float, bool]]
) -> None:
    spans = spans_of(events(*told))
    assert [(span.start, span.end, span.discarded) for span in spans] == expected
    assert [span.number for span in spans] == ([1, 2][: len(expected)] if told else [0])


OUTCOMES = {
    "of the episode that goes on, which it ends": (
        [(1.0, BEGINS), (2.0, SUCCEEDED), (3.0, BEGINS), (4.0, FAILED)],
        [(2.0, True), (4.0, False)],
    ),
    "of the last one, which has ended": ([(1.0, BEGINS), (2.0, ENDS), (2.5, FAILED)], [(2.0, False)]),
    "what was said last": ([(1.0, BEGINS), (2.0, FAILED), (2.5, SUCCEEDED)], [(2.0, True)]),
    "of the run, where no episode is told of": ([(1.0, FAILED)], [(math.inf, False)]),
    "of nobody": ([(1.0, BEGINS)], [(math.inf, None)]),
}


@pytest.mark.parametrize(("told", "expected"), OUTCOMES.values(), ids=OUTCOMES)
def test_success_and_failure_are(told: list[tuple[float, K]], expected: list[tuple[float, bool | None]]) -> None:
    assert [(span.end, span.success) for span in spans_of(events(*told))] == expected


def test_of_the_whole_run_the_operator_knows_better_than_the_check_of_its_task() -> None:
    assert [span.success for span in spans_of([], run_succeeded=True)] == [True]
    assert [span.success for span in spans_of(events((1.0, FAILED)), run_succeeded=True)] == [False]
    assert [span.success for span in spans_of(events((1.0, BEGINS)), run_succeeded=True)] == [None]
