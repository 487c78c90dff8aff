"""Compute figures that show whether an arm's measurements are plausible.

The numbers have to be finite. The joints must not be faster than their speed limits, nor far from the reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from q2r2_control.judging.episode import Episode
from q2r2_control.judging.motion import Track, best_delay
from q2r2_control.types import Array

_SPEED_FRAMES = 10  # The number of frames over which a joint's speed is averaged.
# A joint's measured velocity is compared with its positions if the joint's RMS speed is above this [rad/s].
_MOVES = 0.02
_LONGEST_GAP = 0.05  # A slope of the positions is computed from frames that are at most this far apart [s].
_LARGEST_LAG = 0.35  # The largest lag that is searched for [s].
_STEP = 0.005  # The step between two lags, and between the times at which velocities are compared [s].


@dataclass(frozen=True, slots=True)
class MeasuredFigures:
    """Figures of one arm. The end of the run, in which the arms come to rest, counts only for ``unmeasured_ticks``.

    None means that a figure cannot be computed.
    """

    unmeasured_ticks: int  # The number of ticks with a position, velocity, opening or reference that is not finite.
    # The largest ratio of a joint's mean speed, over 20 ms or over ten frames, to the speed limit of the joint.
    joint_speed_share: float
    velocity_mismatch: float | None  # |k - 1| of the worst joint, where velocity = k * slope of the position.
    reference_lag_ms: float | None  # The lag of the measured joints behind the reference.
    opening_range: float | None  # The largest measured opening minus the smallest; None if none was measured.
    commanded_range: float | None  # The largest commanded opening minus the smallest; None if the arm has no gripper.


def measured_figures(episode: Episode, arm: str) -> MeasuredFigures:
    """Return the figures of an arm. Torques are not checked, since not every plant measures them."""
    index, ticks = episode.arms.index(arm), episode.ticks
    joints, at = episode.robot.arms[arm].joints, episode.frames.at
    following = ticks.following[at]
    t, frames = episode.frame_t[following], episode.frames
    q, v, reference = (numbers[following][:, joints] for numbers in (frames.q, frames.v, frames.reference_q))
    fastest = ticks.joint_speed[ticks.following, index].max(initial=0.0)
    return MeasuredFigures(
        unmeasured_ticks=int(ticks.unmeasured[:, index].sum()),
        joint_speed_share=float(max(fastest, _lasting_speed(t, q, episode.robot.velocity_limit[joints]))),
        velocity_mismatch=_velocity_mismatch(t, q, v),
        reference_lag_ms=_reference_lag(t, q, reference),
        opening_range=_range(frames.opening[following, index]),
        commanded_range=_range(frames.commanded[following, index]),
    )


def _lasting_speed(t: Array, q: Array, limits: Array) -> float:
    """Return the largest ratio of a joint's mean speed, over ten frames (0.1 s), to the ``limits`` of the joints."""
    if len(t) <= _SPEED_FRAMES:
        return 0.0
    passed = np.maximum(t[_SPEED_FRAMES:] - t[:-_SPEED_FRAMES], 1e-9)
    steps = np.abs(q[_SPEED_FRAMES:] - q[:-_SPEED_FRAMES])
    # The measured angle of a joint without position limits may jump by a turn.
    steps = np.where(steps > np.pi, 0.0, steps)
    return float(np.nan_to_num(steps / passed[:, None] / limits, posinf=0.0).max())


def _velocity_mismatch(t: Array, q: Array, v: Array) -> float | None:
    """Return |k - 1| of the worst joint, where v = k dq/dt fits best; k is -1 for velocities of the wrong sign.

    The result is None if no velocity is measured, or if no joint moves.
    """
    if len(t) < 3 or not np.nan_to_num(v).any():  # All numbers are 0 or NaN if velocities are not measured.
        return None
    slope, measured = (q[2:] - q[:-2]) / np.maximum(t[2:] - t[:-2], 1e-9)[:, None], v[1:-1]
    usable = np.isfinite(slope).all(axis=1) & np.isfinite(measured).all(axis=1) & (t[2:] - t[:-2] < _LONGEST_GAP)
    slope, measured = slope[usable], measured[usable]
    moves = np.sum(slope**2, axis=0) > _MOVES**2 * max(len(slope), 1)
    if not moves.any():
        return None
    fit = np.sum(measured * slope, axis=0)[moves] / np.sum(slope**2, axis=0)[moves]
    return float(np.abs(fit - 1.0).max())


def _reference_lag(t: Array, q: Array, reference: Array) -> float | None:
    """Return the lag [ms] of the measured joints behind the reference, as in :func:`delays`.

    The lag is negative if the measured joints are ahead of the reference. It is None if it cannot be computed.
    """
    usable = np.isfinite(q).all(axis=1) & np.isfinite(reference).all(axis=1)
    t, q, reference = t[usable], q[usable], reference[usable]
    if len(t) < 2 or t[-1] - t[0] < 3.0 * _LARGEST_LAG:
        return None
    when = np.arange(t[0] + _LARGEST_LAG, t[-1] - _LARGEST_LAG, _STEP)
    lags = np.arange(-_LARGEST_LAG, _LARGEST_LAG + _STEP, _STEP)
    lag = best_delay(Track(t, reference), Track(t, q), when, lags)
    return None if lag is None else 1e3 * lag


def _range(openings: Array) -> float | None:
    known = openings[np.isfinite(openings)]
    return float(known.max() - known.min()) if len(known) else None
