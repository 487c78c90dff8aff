"""Compute all numbers of an episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from q2r2_control.config.recording import subtask_names
from q2r2_control.judging.camera_figures import CameraFigures, camera_figures
from q2r2_control.judging.episode import Episode
from q2r2_control.judging.measured import MeasuredFigures, measured_figures
from q2r2_control.judging.motion import ArmFigures, arm_figures, idle_share
from q2r2_control.recording.about import LOOP
from q2r2_control.recording.clock_steps import clock_steps
from q2r2_control.recording.messages import hand_pose, loop_topics, target
from q2r2_control.supervision.tick_pacer import MissedTicks
from q2r2_control.teleop.arm_states import is_fault, is_refusal
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import Array, Flags
from q2r2_control.wording import sentence

# Number of frames in one second. If an arm has a target in more frames than this, its target topic must have a message,
# because even a topic with a low rate gets a message in one second.
_SURELY = 100
_SHORTEST = 1e-3  # The shortest time for which an arm counts as engaged [s].


@dataclass(frozen=True, slots=True)
class HandFigures:
    """Figures of one hand while an engaged arm follows it.

    Rates, shares and times are None if no engaged arm ever follows the hand.
    """

    arm: str
    pose_rate_hz: float | None  # The number of received poses divided by the time for which the arm follows.
    dropouts: int  # The number of dropouts. A dropout is a time between two poses that is too long.
    dropout_share: float | None  # The share of the time that is within dropouts.
    longest_gap_s: float | None  # The longest time between two poses.
    unusable_poses: int  # The number of poses that are not finite numbers.
    sample_age_ms_p50: float | None  # Median of the time from the receipt of a pose to the tick that took it.
    sample_age_ms_p99: float | None


def hand_figures(episode: Episode, hand: str, dropout: float) -> HandFigures:
    """Return the figures of a hand's samples. A time between poses is a dropout if it is longer than ``dropout`` [s].

    The time from the last pose to the end counts as a time between poses. Times between poses count only while the arm
    follows the hand and no tick was lost.
    """
    ticks, samples = episode.ticks, episode.hands[hand]
    engaged = (ticks.engaged & ~ticks.by_policy)[:, episode.arms.index(samples.arm)] & ticks.following
    steps = np.where(engaged, ticks.dt, 0.0)
    passed = np.cumsum(steps)  # The time for which the arm was engaged so far [s].
    total = float(passed[-1]) if len(passed) else 0.0
    unusable = ~np.isfinite(samples.position).all(axis=1)
    if total < _SHORTEST:
        return HandFigures(samples.arm, None, 0, None, None, int(unusable.sum()), None, None)
    usable = ~unusable & np.isfinite(samples.received)
    received = np.unique(samples.received[usable])
    taken = usable & _at(ticks.t, engaged, samples.polled)
    ages = samples.polled[taken] - samples.received[taken]
    ends = np.concatenate(([ticks.t[engaged][0]], received, [ticks.t[engaged][-1]]))
    ends = np.maximum.accumulate(ends)
    gaps, inside = np.diff(ends), np.diff(np.interp(ends, ticks.t, passed))
    lost = np.flatnonzero(np.diff(ticks.number) > 1)  # Ticks, and perhaps samples, were lost after these rows.
    with_lost = np.searchsorted(ticks.t[lost + 1], ends[:-1]) < np.searchsorted(ticks.t[lost], ends[1:], side="right")
    counting = (inside > _SHORTEST) & ~with_lost
    long = counting & (gaps > dropout)
    return HandFigures(
        arm=samples.arm,
        pose_rate_hz=float(_at(ticks.t, engaged, received).sum() / total),
        dropouts=int(long.sum()),
        dropout_share=float(inside[long].sum() / total),
        longest_gap_s=float(gaps[counting].max(initial=0.0)),
        unusable_poses=int(unusable.sum()),
        sample_age_ms_p50=None if not len(ages) else 1e3 * float(np.percentile(ages, 50)),
        sample_age_ms_p99=None if not len(ages) else 1e3 * float(np.percentile(ages, 99)),
    )


def _at(t: Array, flags: Flags, when: Array) -> Flags:
    """Return the newest flag at or before each of the times ``when``; False if there is none.

    The ``flags`` (n,) have the times ``t`` (n,).
    """
    at = np.searchsorted(t, when, side="right") - 1
    return np.asarray((at >= 0) & flags[np.maximum(at, 0)])


_LATE = 1.5  # A tick is late after more than this number of periods.


@dataclass(frozen=True, slots=True)
class Fault:
    """A pause of an arm that the operator did not request."""

    t: float  # Time since the run began [s].
    arm: str
    kind: str  # The kind of the event's reason.
    reason: str  # The reason in words.


@dataclass(frozen=True, slots=True)
class TimingFigures:
    """Figures of all ticks, also of those at the end of the run. Shares and maxima are None if there are no ticks."""

    ticks: int  # The number of ticks that are in the file.
    lost_ticks: int  # The number of ticks that are missing in the file, up to its last tick.
    lost_share: float | None
    longest_lost_s: float  # The longest time span that has no tick in the file.
    late_ticks: int  # The number of ticks that come more than 1.5 periods after the tick before.
    missed_ticks: int  # The number of ticks that were due and never came.
    missed_share: float | None  # The number of missed ticks divided by the number of ticks that were due.
    longest_tick_s: float | None  # The longest time between two ticks of the loop.
    compute_time_us_p99: float | None
    ended: bool  # True if the run came to its planned end, or if the operator ended the episode.
    # The number of ticks that have the same time as the tick before. None for a recording of ROS nodes, because several
    # of their messages may arrive together.
    repeated_stamps: int | None
    clock_step_s: float  # The largest step by which a clock was set: negative if it was set back, 0 if none was set.
    begins_again: bool  # True if arms follow again after a run has begun to end. The file then contains two runs.


@dataclass(frozen=True, slots=True)
class SubtaskFigures:
    """One subtask of an episode. It ends when the operator begins the next subtask, or with the episode."""

    name: str
    start_s: float  # Time since the episode began.
    duration_s: float


def subtask_figures(episode: Episode, duration: float) -> list[SubtaskFigures]:
    """Return the subtasks of an episode that has this ``duration`` [s].

    The list is empty if the cell names no subtask and the operator marked none.
    """
    names = subtask_names(episode.config.recording.subtasks, len(episode.subtask_starts))
    ends = (*episode.subtask_starts, duration)
    starts = (0.0, *episode.subtask_starts)
    return [
        SubtaskFigures(name, start, max(end - start, 0.0))
        for name, start, end in zip(names, starts, ends, strict=False)
    ]


@dataclass(frozen=True, slots=True)
class EpisodeFigures:
    """The numbers of one episode. Shares are from 0 to 1. None means that a number cannot be computed."""

    file: str
    part: int | None  # The number of the episode in the file, from 1 on; None for the whole file.
    task: str | None  # The task in words; None if it is not known.
    duration_s: float  # The duration without the end of the run, in which the arms come to rest.
    engaged_s: float  # The time for which at least one arm is engaged.
    idle_share: float | None
    hands: dict[str, HandFigures]
    arms: dict[str, ArmFigures]
    measured: dict[str, MeasuredFigures]  # The figures of the measurements, by arm.
    cameras: dict[str, CameraFigures]
    empty_topics: list[str]  # The topics that should have a message and have none.
    faults: list[Fault]
    fallback_ticks: int
    fallback_share: float | None
    uncertified_ticks: int
    uncertified_share: float | None
    min_distance_mm: float | None  # The distance of the nearest monitored pair, at the controller's reference.
    min_margin_mm: float | None  # The distance of the tightest pair minus the distance that it has to keep.
    timing: TimingFigures
    damage: str | None  # The reason why the file cannot be read to its end; None if it can.
    ended_by: str | None  # The fault that ended the run; None if no fault did.
    discarded: bool  # True if the operator discarded the episode.
    # True if the episode succeeded, as the task's own check or the operator says; None if that is not known.
    success: bool | None
    subtasks: list[SubtaskFigures]  # In the order of time; see :func:`subtask_figures`.
    missing_subtasks: list[str]  # The names of the cell's subtasks that the operator did not begin.

    @property
    def name(self) -> str:
        return Path(self.file).stem + ("" if self.part is None else f" #{self.part}")


def figures_of(episode: Episode, dropout: float) -> EpisodeFigures:
    """Return the numbers of an episode. A time between poses of a hand is a dropout if it exceeds ``dropout`` [s]."""
    ticks, following, count = episode.ticks, episode.ticks.following, len(episode.ticks.t)
    engaged = ticks.engaged.any(axis=1) & following
    duration = float(ticks.t[following][-1]) if following.any() else 0.0
    subtasks = subtask_figures(episode, duration)
    return EpisodeFigures(
        file=str(episode.recording.file),
        part=episode.part,
        task=episode.recording.about.notes.get("task"),
        duration_s=duration,
        engaged_s=float(ticks.dt[engaged].sum()),
        idle_share=idle_share(episode),
        hands={hand: hand_figures(episode, hand, dropout) for hand in episode.hands},
        arms={arm: arm_figures(episode, arm) for arm in episode.arms},
        measured={arm: measured_figures(episode, arm) for arm in episode.arms},
        cameras=camera_figures(episode),
        empty_topics=_empty_topics(episode),
        # A refused press does not count as a fault, since nothing moved. If a fault of one arm also pauses the
        # other arm, the pause of the other arm does not count.
        faults=[
            Fault(event.t, event.arm, str(event.reason.root.kind), sentence(event.reason))
            for event in episode.events
            if is_fault(event) and not is_refusal(event) and event.kind is not TeleopReason.LINKED
        ],
        fallback_ticks=int(ticks.fallback.sum()),
        fallback_share=float(ticks.fallback.mean()) if count else None,
        uncertified_ticks=int((~ticks.certified).sum()),
        uncertified_share=float((~ticks.certified).mean()) if count else None,
        min_distance_mm=_least_mm(ticks.distance),
        min_margin_mm=_least_mm(ticks.margin),
        timing=timing_figures(episode),
        damage=episode.damage,
        ended_by=episode.ended_by,
        discarded=episode.discarded,
        success=episode.success,
        subtasks=subtasks,
        missing_subtasks=list(episode.config.recording.subtasks[len(subtasks) :]),
    )


def _empty_topics(episode: Episode) -> list[str]:
    """Return the topics that should have a message and have none.

    The list is empty for a file without an index, because the numbers of its messages are not known. It is also empty
    for a recording of ROS nodes, because the nodes may have published nothing.
    """
    about, counts = episode.recording.about, episode.recording.counts
    if about.source != LOOP or counts is None or not len(episode.ticks.t):
        return []
    # (arms,) The number of frames in which each arm has a target.
    asked = (episode.frames.target != episode.frames.reference).any(axis=2).sum(axis=0)
    expected = list(loop_topics(about.arms))
    expected += [target(arm) for arm, count in zip(about.arms, asked.tolist(), strict=True) if count > _SURELY]
    expected += [hand_pose(name) for name, hand in episode.hands.items() if len(hand.received)]
    return [topic for topic in expected if not counts.get(topic)]


def _least_mm(distances: Array) -> float | None:
    known = distances[np.isfinite(distances)]
    return 1e3 * float(known.min()) if len(known) else None


def timing_figures(episode: Episode) -> TimingFigures:
    """Return the figures of all ticks. The number of missed ticks is computed from the ``dt`` of each tick."""
    ticks, count = episode.ticks, len(episode.ticks.t)
    if not count:
        return TimingFigures(0, 0, None, 0.0, 0, 0, None, None, None, episode.ended, 0, 0.0, False)
    period = 1.0 / episode.config.nominal_rate_hz
    # The first tick of a run has number 0, so a tick -1 is assumed before it.
    lost = np.diff(ticks.number, prepend=-1) - 1
    gaps = np.diff(ticks.t, prepend=0.0) - ticks.dt
    steps = clock_steps(ticks.number, ticks.t, ticks.dt)
    counter = MissedTicks()
    for gap in (ticks.dt / period).tolist():
        counter.add(gap)
    missed = counter.count
    return TimingFigures(
        ticks=count,
        lost_ticks=int(lost.sum()),
        lost_share=float(lost.sum() / (lost.sum() + count)),
        longest_lost_s=float(gaps[lost > 0].max(initial=0.0)),
        late_ticks=int((ticks.dt > _LATE * period).sum()),
        missed_ticks=missed,
        missed_share=missed / (missed + count),
        longest_tick_s=float(ticks.dt.max()),
        compute_time_us_p99=1e6 * float(np.percentile(ticks.compute_time, 99)),
        ended=episode.ended,
        repeated_stamps=_repeated_stamps(episode),
        clock_step_s=float(steps[np.argmax(np.abs(steps))]),
        begins_again=bool((np.diff(ticks.following.astype(int)) > 0).any()),
    )


def _repeated_stamps(episode: Episode) -> int | None:
    if episode.recording.about.source != LOOP:
        return None
    ticks = episode.ticks
    return int(((np.diff(ticks.t) <= 0.0) | (np.diff(ticks.now) <= 0.0)).sum())
