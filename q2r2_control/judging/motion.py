"""Measure how well the arms followed, how smooth and how late their motion was, and whether they moved at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from q2r2_control.judging.episode import FRAME, Episode, stretches
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import Array, Flags

# Duration of a piece [s]. Smoothness is computed for short, overlapping time spans of a motion, which are called
# pieces.
PIECE = 1.0
_HOP = 0.25  # The time from the start of one piece to the start of the next [s].
_FEWEST = 8  # Without at least this number of pieces, no smoothness is computed.
_SLOWEST = 0.02  # Pieces with a lower mean speed of the tool do not count [m/s].
_LONGEST_GAP = 0.05  # If two frames are farther apart than this, no piece may contain both [s].
# Positions are smoothed by a Gaussian with this standard deviation before the jerk is computed [s]. The Gaussian halves
# the power at 6.6 Hz.
_SMOOTHING = 0.02
LONGEST = 0.5  # The longest delay that is searched for [s].
_STEP = 0.005  # The step between two delays, and between the times at which velocities are compared [s].
_DIFFERENCE = 0.025  # A velocity is computed from the positions this much earlier and this much later [s].
_LEAST_MOTION = 0.01  # No delay is computed for a hand whose RMS speed is lower [m/s].
_LEAST_FIT = 0.5  # The least share of the tool's motion that the hand's motion has to explain.
# If a motion repeats itself, several delays explain it. A longer delay is therefore chosen only if it explains a
# larger share of the motion. The share must be larger by at least this for each second of additional delay [1/s].
_ALIKE = 0.01
_LOOK = 0.5  # A tool's pose is compared with the poses that the tool has this much earlier and later [s].
_MOVED, _TURNED = 2e-3, 0.02  # A tool moves if its pose differs from one of them by more than this [m, rad].


def smoothness(t: Array, position: Array, engaged: Flags) -> float | None:
    """Return how smooth a tool's motion is: the median of :func:`ldlj` over pieces of the motion, which last 1 s.

    The tool has the ``position`` (n, 3) [m] at the times ``t`` (n,) [s]. The positions are smoothed first. The result
    is None if fewer than eight pieces have a mean speed above 20 mm/s while the arm is ``engaged`` (n,).
    """
    moving = []
    for begin, end in stretches(engaged & np.isfinite(position).all(axis=1)):
        moving += _pieces(t[begin:end], position[begin:end])
    if len(moving) < _FEWEST:
        return None
    # In real time many ticks come a millisecond late. If a tool moves at 0.3 m/s, its recorded position then has an
    # error of 0.3 mm. The third derivative of this error is larger than the jerk of the motion itself, so positions are
    # smoothed. The smoothing falsifies both ends of a piece, so the ends are cut off.
    cut = round(2.0 * _SMOOTHING / FRAME)
    smoothed = [gaussian_filter1d(piece, _SMOOTHING / FRAME, axis=0)[cut:-cut] for piece in moving]
    return float(np.median([ldlj(piece, FRAME) for piece in smoothed]))


def _pieces(t: Array, position: Array) -> list[Array]:
    """Return, for each piece in which the tool moves, positions (k, 3) [m] at times that are :data:`FRAME` apart."""
    count, hop = round(PIECE / FRAME) + 1, round(_HOP / FRAME)
    if len(t) < count // 2 or t[-1] - t[0] < PIECE:
        return []
    t, first = np.unique(t, return_index=True)
    when = np.arange(t[0], t[-1], FRAME)
    even = CubicSpline(t, position[first])(when)
    after = np.clip(np.searchsorted(t, when, side="right"), 1, len(t) - 1)
    gaps = t[after] - t[after - 1]
    speed = np.linalg.norm(np.diff(even, axis=0), axis=1) / FRAME
    return [
        even[begin : begin + count]
        for begin in range(0, len(when) - count + 1, hop)
        if speed[begin : begin + count - 1].mean() > _SLOWEST and gaps[begin : begin + count].max() < _LONGEST_GAP
    ]


def ldlj(position: Array, dt: float) -> float:
    """Return the log dimensionless jerk along positions (k, 3) [m] that are ``dt`` [s] apart.

    LDLJ = -ln(T^3 / v_peak^2 * integral of |d^3 x / dt^3|^2 dt) over the duration T (Balasubramanian,
    Melendez-Calderon, Roby-Brami, Burdet, On the analysis of movement smoothness, JNER 2015). The dimensionless jerk is
    defined by Hogan and Sternad, Sensitivity of smoothness measures to movement duration, 2009. A single reach of
    minimum jerk has an LDLJ of about -5.3.
    """
    velocity = np.diff(position, axis=0) / dt
    jerk = np.diff(velocity, n=2, axis=0) / dt**2
    peak = max(float(np.linalg.norm(velocity, axis=1).max()), np.finfo(float).tiny)
    duration = dt * (len(position) - 1)
    total = duration**3 / peak**2 * float(np.sum(jerk * jerk)) * dt
    return -float(np.log(max(total, np.finfo(float).tiny)))


class Track(NamedTuple):
    """The positions of a moving point, or of joints, over time."""

    t: Array  # (n,) Ascending times [s].
    position: Array  # (n, 3) [m], or (n, joints) [rad].

    def velocity(self, when: Array) -> Array:
        """Return the velocity (m, 3) [m/s], or (m, joints) [rad/s], at times ``when`` (m,) [s].

        It is computed from two positions that are 50 ms apart. Before and after the track, positions count as constant.
        """
        ahead, behind = (
            np.stack([np.interp(when + shift, self.t, column) for column in self.position.T], axis=1)
            for shift in (_DIFFERENCE, -_DIFFERENCE)
        )
        return (ahead - behind) / (2.0 * _DIFFERENCE)


def delays(episode: Episode, hand: str) -> list[float | None]:
    """Return the delays of the target and of the measured tool behind the received poses of a hand [s].

    A delay is the tau that maximises the squared correlation of v(t) with M v_hand(t - tau) over all times t at which
    the arm is engaged. Here v is the velocity of the target or tool, and M (3, 3) maps the hand's axes to the world, as
    the teleoperation does. The anchors, the scale and the time for which the hand rests do not matter. A delay is None
    in three cases: The hand has an RMS speed below 10 mm/s, for example because it only turns. The hand's motion
    explains less than half of the motion of the target or tool. No maximum is within (0, 0.5) s.
    """
    samples = episode.hands[hand]
    arm = episode.arms.index(samples.arm)
    usable = np.isfinite(samples.position).all(axis=1) & np.isfinite(samples.received)
    received, first = np.unique(samples.received[usable], return_index=True)
    if len(received) < 2:
        return [None, None]
    motion = RelativeMotion(episode.config.teleop.stance, axes=episode.config.teleop.axes)
    motion.anchor(pin.SE3.Identity(), pin.SE3.Identity())
    axes = np.array([motion.target(pin.SE3(np.eye(3), axis)).translation for axis in np.eye(3)])  # The transpose of M.
    position = samples.position[usable][first] @ axes
    t = episode.frame_t
    times = [
        np.arange(t[begin] + LONGEST + _DIFFERENCE, t[end - 1] - _DIFFERENCE, _STEP)
        for begin, end in stretches(episode.engaged[:, arm])
        if t[end - 1] - t[begin] > LONGEST + 0.1
    ]
    if not times:
        return [None, None]
    followers = [Track(t, np.nan_to_num(poses[:, arm, :3])) for poses in (episode.frames.target, episode.tools)]
    return delays_behind(Track(received, position), followers, np.concatenate(times))


def delays_behind(hand: Track, followers: Sequence[Track], when: Array) -> list[float | None]:
    """Return the delay [s] of each follower behind ``hand``, at times ``when`` (n,) [s]; None as in :func:`delays`."""
    lags = np.arange(0.0, LONGEST + _STEP, _STEP)
    by_hand = [hand.velocity(when - lag) for lag in lags]
    return [_best(lags, by_hand, follower.velocity(when)) for follower in followers]


def best_delay(leader: Track, follower: Track, when: Array, lags: Array) -> float | None:
    """Return the delay [s] of ``follower`` behind ``leader``, at times ``when`` (n,) [s]; None as in :func:`delays`.

    The delay is searched for among ``lags`` [s], which are 5 ms apart and may be negative.
    """
    return _best(lags, [leader.velocity(when - lag) for lag in lags], follower.velocity(when))


def _best(lags: Array, by_hand: list[Array], moved: Array) -> float | None:
    """Return the delay [s] with the highest correlation, interpolated between two ``lags`` [s].

    Of several delays with nearly the same correlation, the delay nearest to zero is returned. The result is None if no
    delay explains enough of the motion, or if the best delay is the first or the last of ``lags``.

    Args:
        lags: The delays to compare (k,) [s].
        by_hand: For each delay, the velocities of the hand at times that are earlier by that delay.
        moved: The velocities of the follower (n, 3) or (n, joints).
    """
    energy = float(np.sum(moved * moved))
    fits = np.zeros(len(lags))
    for index, hand in enumerate(by_hand):
        power, product = float(np.sum(hand * hand)), float(np.sum(hand * moved))
        if product > 0.0 and power > _LEAST_MOTION**2 * len(hand):
            fits[index] = product * product / (power * energy)
    best = int(np.argmax(fits - _ALIKE * np.abs(lags)))
    if fits[best] < _LEAST_FIT or not 0 < best < len(lags) - 1:
        return None
    before, peak, after = fits[best - 1 : best + 2]
    bend = before - 2.0 * peak + after
    return float(lags[best] + (0.5 * _STEP * (before - after) / bend if bend < 0.0 else 0.0))


@dataclass(frozen=True, slots=True)
class ArmFigures:
    """Figures of one arm over the time for which it is engaged. None means that a figure cannot be computed."""

    engaged_s: float
    position_error_mm_rms: float | None  # Errors are differences between the target and the measured tool pose.
    position_error_mm_p99: float | None
    rotation_error_deg_rms: float | None
    rotation_error_deg_p99: float | None
    hand_to_target_ms: float | None
    hand_to_tool_ms: float | None
    rejected_share: float | None  # The share of ticks with a target that is not usable.
    leashed_share: float | None  # The share of ticks in which the leash dragged the target.
    slip_mm: float  # The total distance by which the leash dragged the target.
    slip_deg: float  # The total angle by which the leash dragged the target.
    ldlj: float | None
    gripper_changes: int  # The number of changes of the wanted opening.


def arm_figures(episode: Episode, arm: str) -> ArmFigures:
    """Return the figures of an arm. Delays come from :func:`delays`, and smoothness comes from :func:`smoothness`."""
    index = episode.arms.index(arm)
    ticks = episode.ticks
    engaged = ticks.engaged[:, index] & ticks.following
    position, rotation = (error[np.isfinite(error)] for error in tracking_errors(episode, index))
    hand = next(hand for hand, samples in episode.hands.items() if samples.arm == arm)
    to_target, to_tool = delays(episode, hand)
    slips = [_rise(slip[:, index], engaged) for slip in (ticks.slip, ticks.slip_angle)]
    return ArmFigures(
        engaged_s=float(ticks.dt[engaged].sum()),
        position_error_mm_rms=_rms(1e3 * position),
        position_error_mm_p99=_p99(1e3 * position),
        rotation_error_deg_rms=_rms(np.degrees(rotation)),
        rotation_error_deg_p99=_p99(np.degrees(rotation)),
        hand_to_target_ms=None if to_target is None else 1e3 * to_target,
        hand_to_tool_ms=None if to_tool is None else 1e3 * to_tool,
        rejected_share=_share(ticks.rejected[:, index], engaged),
        leashed_share=_share((slips[0] > 0.0) | (slips[1] > 0.0), engaged),
        slip_mm=1e3 * float(slips[0].sum()),
        slip_deg=float(np.degrees(slips[1].sum())),
        ldlj=smoothness(episode.frame_t, episode.tools[:, index, :3], episode.engaged[:, index]),
        gripper_changes=int((np.diff(ticks.gripper[ticks.following, index]) != 0.0).sum()),
    )


def tracking_errors(episode: Episode, arm: int) -> tuple[Array, Array]:
    """Return the distance (m,) [m] and angle (m,) [rad] of the measured tool from the target at the frames.

    They are NaN while the arm is not engaged.
    """
    tools, targets, engaged = episode.tools[:, arm], episode.frames.target[:, arm], episode.engaged[:, arm]
    position = np.linalg.norm(tools[:, :3] - targets[:, :3], axis=1)
    rotation = _angles(tools[:, 3:], targets[:, 3:])
    return np.where(engaged, position, np.nan), np.where(engaged, rotation, np.nan)


def idle_share(episode: Episode) -> float | None:
    """Return the share of the run in which no engaged arm moves. The end of the run is left out.

    An arm moves if its tool pose, at the controller's reference, differs by more than 2 mm or 0.02 rad from its pose
    half a second earlier or later. It also moves if its gripper gets another command in that time. Thus an arm that
    follows a trembling hand is idle, and a short stop between two motions is not. The result is None if no tick is in
    the file.
    """
    t, at = episode.frame_t, episode.frames.at
    moving = np.zeros(len(t), dtype=bool)
    for arm in range(len(episode.arms)):
        poses, gripper = episode.frames.reference[:, arm], episode.ticks.gripper[at, arm]
        for shift in (-_LOOK, _LOOK):
            other = np.clip(np.searchsorted(t, t + shift), 0, max(len(t) - 1, 0))
            moves = np.linalg.norm(poses[other, :3] - poses[:, :3], axis=1) > _MOVED
            moves |= (_angles(poses[other, 3:], poses[:, 3:]) > _TURNED) | (gripper[other] != gripper)
            moving |= episode.engaged[:, arm] & moves
    following = episode.ticks.following[at]
    return float(1.0 - moving[following].mean()) if following.any() else None


def _angles(a: Array, b: Array) -> Array:
    """Return the angles (n,) [rad] between rotations that are given as quaternions (n, 4)."""
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(np.sum(a * b, axis=1)), 0.0, 1.0)))


def _rise(values: Array, engaged: Flags) -> Array:
    """Return the increase (n,) of ``values`` since the tick before.

    It is 0 where the values decrease, and where the arm is not engaged in both ticks.
    """
    rise = np.diff(values, prepend=values[:1])
    return np.where(engaged & np.concatenate(([False], engaged[:-1])), np.maximum(rise, 0.0), 0.0)[: len(values)]


def _share(flags: Flags, among: Flags) -> float | None:
    return float(flags[among].mean()) if among.any() else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _p99(values: Array) -> float | None:
    return float(np.percentile(values, 99)) if len(values) else None
