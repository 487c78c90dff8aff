"""Whether an episode is kept, and every reason why not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.judging.figures import EpisodeFigures


@dataclass(frozen=True, slots=True)
class Rejection:
    """Why an episode is discarded."""

    name: str  # of the threshold, or of what no threshold says: never_engaged, damaged, ended_by, operator
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Kept, or discarded for all of the ``reasons``."""

    reasons: tuple[Rejection, ...]

    @property
    def keep(self) -> bool:
        """Whether there is no reason to discard it."""
        return not self.reasons

    @property
    def word(self) -> str:
        """For people and programs."""
        return "keep" if self.keep else "discard"

    @property
    def line(self) -> str:
        """The word and the reasons."""
        reasons = "; ".join(reason.text for reason in self.reasons)
        return f"{self.word}: {reasons}" if reasons else self.word


class _Unit(NamedTuple):
    """How a number is shown."""

    name: str = ""
    scale: float = 1.0  # from the threshold's own unit, of the SI


_PLAIN = _Unit()


@dataclass(frozen=True, slots=True)
class _Threshold:
    """A limit of a number of an episode, or of each of its hands or arms."""

    name: str  # min_...: at least; max_...: at most
    of: Literal["episode", "hand", "arm", "timing"]
    figure: str
    words: str
    unit: _Unit = _PLAIN
    figure_in_unit: bool = False  # and not in the threshold's

    def reason(self, value: float | None, limit: float | None, whose: str) -> Rejection | None:
        """Why a value is beyond the limit; what is None is not judged."""
        if value is None or limit is None:
            return None
        scale, at_least = self.unit.scale, self.name.startswith("min_")
        found = value / scale if self.figure_in_unit else value
        if found >= limit if at_least else found <= limit:
            return None
        shown = f"{whose}{self.words} {scale * found:.1f} {self.unit.name}".strip()
        bound = "at least" if at_least else "at most"
        return Rejection(self.name, f"{shown} ({bound} {scale * limit:.4g})")


_MM, _MS, _DEGREES = _Unit("mm", 1e3), _Unit("ms", 1e3), _Unit("deg", math.degrees(1.0))
_PERCENT, _OF_TIME, _OF_TICKS = (_Unit(f"%{of}", 1e2) for of in ("", " of the time", " of the ticks"))
_THRESHOLDS = (
    _Threshold("min_pose_rate", "hand", "pose_rate_hz", "poses at", _Unit("Hz")),
    _Threshold("max_dropout_share", "hand", "dropout_share", "dropouts", _OF_TIME),
    _Threshold("max_pose_gap", "hand", "longest_gap_s", "no pose for", _MS),
    _Threshold("max_sample_age", "hand", "sample_age_ms_p99", "poses are old when they are used, p99", _MS, True),
    _Threshold("max_delay", "arm", "hand_to_tool_ms", "moves later than its hand by", _MS, True),
    _Threshold("max_rejected_share", "arm", "rejected_share", "unusable targets", _PERCENT),
    _Threshold("max_leashed_share", "arm", "leashed_share", "leash dragged", _OF_TIME),
    _Threshold("max_position_error_rms", "arm", "position_error_mm_rms", "tracking error RMS", _MM, True),
    _Threshold("max_position_error_p99", "arm", "position_error_mm_p99", "tracking error p99", _MM, True),
    _Threshold("max_rotation_error_rms", "arm", "rotation_error_deg_rms", "tracking error RMS", _DEGREES, True),
    _Threshold("max_rotation_error_p99", "arm", "rotation_error_deg_p99", "tracking error p99", _DEGREES, True),
    _Threshold("min_ldlj", "arm", "ldlj", "not smooth, LDLJ"),
    _Threshold("max_idle_share", "episode", "idle_share", "idle: no engaged arm moves", _PERCENT),
    _Threshold("max_fallback_share", "episode", "fallback_share", "certified stops executed", _OF_TICKS),
    _Threshold("max_uncertified_share", "episode", "uncertified_share", "without a certified stop", _OF_TICKS),
    _Threshold("min_margin", "episode", "min_margin_mm", "nearer than a pair may be: margin", _MM, True),
    _Threshold("max_lost_share", "timing", "lost_share", "ticks lost in the recording", _OF_TICKS),
    _Threshold("max_lost_gap", "timing", "longest_lost_s", "ticks lost in the recording, at once", _MS),
    _Threshold("max_missed_share", "timing", "missed_share", "loop was late: missed", _OF_TICKS),
    _Threshold("max_tick_gap", "timing", "longest_tick_s", "loop stood still for", _MS),
)


def verdict_of(figures: EpisodeFigures, settings: JudgeSettings) -> Verdict:
    """Hold an episode's numbers to thresholds; a number that is None is not judged."""
    reasons = list(_unreadable(figures, settings))
    if not figures.engaged_s > 0.0:
        return Verdict((*reasons, Rejection("never_engaged", "no arm was ever engaged")))
    groups: dict[str, dict[str, Any]] = {
        "hand": {f"{name} hand: ": hand for name, hand in figures.hands.items()},
        "arm": {f"{name} arm: ": arm for name, arm in figures.arms.items()},
        "episode": {"": figures},
        "timing": {"": figures.timing},
    }
    for threshold in _THRESHOLDS:
        for whose, found in groups[threshold.of].items():
            value, limit = getattr(found, threshold.figure), getattr(settings, threshold.name)
            if (reason := threshold.reason(value, limit, whose)) is not None:
                reasons.append(reason)
    if settings.max_faults is not None and len(figures.faults) > settings.max_faults:
        first = figures.faults[0]
        also = f", and {len(figures.faults) - 1} more" if len(figures.faults) > 1 else ""
        what = f"fault: {first.arm} arm at {first.t:.2f} s: {first.reason}{also} (at most {settings.max_faults})"
        reasons.append(Rejection("max_faults", what))
    return Verdict(tuple(reasons))


def _unreadable(figures: EpisodeFigures, settings: JudgeSettings) -> Iterator[Rejection]:
    if figures.discarded:
        yield Rejection("operator", "its operator discarded it")
    if figures.success is False and not settings.keep_failed:
        yield Rejection("keep_failed", "it failed, as its operator or task says")
    if figures.ended_by is not None:
        yield Rejection("ended_by", f"a fault ended the run: {figures.ended_by}")
    if figures.damage is not None:
        yield Rejection("damaged", f"after {figures.duration_s:.2f} s {figures.damage}")
    elif settings.needs_end and not figures.timing.ended:
        yield Rejection("needs_end", "the recording has no end: its process was killed, or the disk was full")
