"""Find contradictions in an episode's file: two facts that cannot both be true."""

from __future__ import annotations

import re
from collections.abc import Iterator

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.judging.figures import EpisodeFigures
from q2r2_control.judging.thresholds import Rejection
from q2r2_control.recording.clock_steps import clock_step_text

_CONSTANT = 0.05  # A gripper did not move if its opening varied by less than this share of its stroke.
_CLOSES = 0.5  # A gripper has to move if its commands vary by more than this share of its stroke.
_GRASPS = re.compile(
    r"\b(grasp|grip(?!per)|pick|place|stack|lift|carr(y|ies)|insert|hand(s|ed|ing)? .*\b(over|to) |handover|"
    r"put (.* )?(in|into|on|onto)\b)",
    re.IGNORECASE,
)


def contradictions(figures: EpisodeFigures, settings: JudgeSettings) -> Iterator[Rejection]:
    """Yield the contradictions of an episode as reasons to discard it.

    Unlike other reasons, contradictions have no thresholds. The only setting that matters here is ``needs_task``.
    """
    if figures.timing.repeated_stamps:
        count = figures.timing.repeated_stamps
        yield Rejection("repeated_stamps", f"{count} ticks have the time of the tick before")
    if figures.timing.clock_step_s:
        yield Rejection("clock_set", clock_step_text(figures.timing.clock_step_s))
    if figures.timing.begins_again:
        yield Rejection("begins_again", "the run goes on after its end: two runs are in one file")
    if figures.empty_topics:
        yield Rejection("empty_topics", f"no message on {', '.join(figures.empty_topics)}")
    if figures.task is not None and not figures.task.strip():
        yield Rejection("empty_task", "its task is an empty text")
    elif figures.task is None and settings.needs_task:
        yield Rejection("needs_task", "it has no task")
    for name, camera in figures.cameras.items():
        if camera.swapped_with is not None:
            what = f"camera {name}: its pictures seem to be those of camera {camera.swapped_with}"
            yield Rejection("swapped_cameras", what)
    yield from _grippers(figures)


def _grippers(figures: EpisodeFigures) -> Iterator[Rejection]:
    grippers = {arm: found for arm, found in figures.measured.items() if found.commanded_range is not None}
    ranges = [found.commanded_range or 0.0 for found in grippers.values()]
    if ranges and max(ranges) < _CONSTANT and (word := _GRASPS.search(figures.task or "")) is not None:
        yield Rejection("constant_gripper", f"no gripper is told to move, and the task says '{word.group(0).strip()}'")
    for arm, found in grippers.items():
        commanded, measured = found.commanded_range or 0.0, found.opening_range
        if measured is not None and commanded > _CLOSES and measured < _CONSTANT:
            yield Rejection("stuck_gripper", f"{arm} arm: its gripper was told to move and did not")
