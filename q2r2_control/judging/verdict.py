"""Whether an episode is kept, and every reason why not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from q2r2_control.config.judge import JudgeSettings
from q2r2_control.judging.figures import EpisodeFigures

_MM, _MS, _PERCENT, _DEGREES = 1e3, 1e3, 1e2, 57.29577951308232


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


def verdict_of(figures: EpisodeFigures, settings: JudgeSettings) -> Verdict:
    """Hold an episode's numbers to thresholds; a number that is None is not judged."""
    reasons = list(_unreadable(figures, settings))
    if not figures.engaged_s > 0.0:
        return Verdict((*reasons, Rejection("never_engaged", "no arm was ever engaged")))
    found = _Limits(settings, reasons)
    _add_hands(found, figures)
    _add_arms(found, figures)
    found.above("max_idle_share", "idle: no engaged arm moves", figures.idle_share, _PERCENT, "%")
    found.above("max_fallback_share", "certified stops executed", figures.fallback_share, _PERCENT, "% of the ticks")
    uncertified = figures.uncertified_share
    found.above("max_uncertified_share", "without a certified stop", uncertified, _PERCENT, "% of the ticks")
    margin = None if figures.min_margin_mm is None else figures.min_margin_mm / _MM
    found.below("min_margin", "nearer than a pair may be: margin", margin, _MM, "mm")
    timing = figures.timing
    found.above("max_lost_share", "ticks lost in the recording", timing.lost_share, _PERCENT, "% of the ticks")
    found.above("max_lost_gap", "ticks lost in the recording, at once", timing.longest_lost_s, _MS, "ms")
    found.above("max_missed_share", "loop was late: missed", timing.missed_share, _PERCENT, "% of the ticks")
    found.above("max_tick_gap", "loop stood still for", timing.longest_tick_s, _MS, "ms")
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


def _add_hands(found: _Limits, figures: EpisodeFigures) -> None:
    for name, hand in figures.hands.items():
        found.below("min_pose_rate", f"{name} hand: poses at", hand.pose_rate_hz, 1.0, "Hz")
        found.above("max_dropout_share", f"{name} hand: dropouts", hand.dropout_share, _PERCENT, "% of the time")
        found.above("max_pose_gap", f"{name} hand: no pose for", hand.longest_gap_s, _MS, "ms")
        age = None if hand.sample_age_ms_p99 is None else hand.sample_age_ms_p99 / _MS
        found.above("max_sample_age", f"{name} hand: poses are old when they are used, p99", age, _MS, "ms")


def _add_arms(found: _Limits, figures: EpisodeFigures) -> None:
    for name, arm in figures.arms.items():
        delay = None if arm.hand_to_tool_ms is None else arm.hand_to_tool_ms / _MS
        found.above("max_delay", f"{name} arm: moves later than its hand by", delay, _MS, "ms")
        found.above("max_rejected_share", f"{name} arm: unusable targets", arm.rejected_share, _PERCENT, "%")
        leashed = arm.leashed_share
        found.above("max_leashed_share", f"{name} arm: leash dragged", leashed, _PERCENT, "% of the time")
        for threshold, what, value, unit, scale in (
            ("position_error_rms", "tracking error RMS", arm.position_error_mm_rms, "mm", _MM),
            ("position_error_p99", "tracking error p99", arm.position_error_mm_p99, "mm", _MM),
            ("rotation_error_rms", "tracking error RMS", arm.rotation_error_deg_rms, "deg", _DEGREES),
            ("rotation_error_p99", "tracking error p99", arm.rotation_error_deg_p99, "deg", _DEGREES),
        ):
            given = None if value is None else value / scale
            found.above(f"max_{threshold}", f"{name} arm: {what}", given, scale, unit)
        found.below("min_sparc", f"{name} arm: not smooth, SPARC", arm.sparc, 1.0, "")
        found.below("min_ldlj", f"{name} arm: not smooth, LDLJ", arm.ldlj, 1.0, "")


class _Limits:
    """Adds a reason for every number beyond its threshold."""

    def __init__(self, settings: JudgeSettings, reasons: list[Rejection]) -> None:
        self._settings, self._reasons = settings, reasons

    def above(self, name: str, what: str, value: float | None, scale: float, unit: str) -> None:
        """Of a number that is to be ``name`` at most."""
        limit = getattr(self._settings, name)
        if limit is not None and value is not None and not value <= limit:
            self._add(name, what, value, limit, scale, unit, "at most")

    def below(self, name: str, what: str, value: float | None, scale: float, unit: str) -> None:
        """Of a number that is to be ``name`` at least."""
        limit = getattr(self._settings, name)
        if limit is not None and value is not None and not value >= limit:
            self._add(name, what, value, limit, scale, unit, "at least")

    def _add(self, name: str, what: str, value: float, limit: float, scale: float, unit: str, bound: str) -> None:
        with_unit = f"{scale * value:.1f} {unit}".strip()
        self._reasons.append(Rejection(name, f"{what} {with_unit} ({bound} {scale * limit:.4g})"))
