"""How much later a tool moves than the hand that leads it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.judging.episode import Episode, stretches
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import Array

LONGEST = 0.5  # delay that is looked for [s]
_STEP = 0.005  # of delays, and of the times that are compared [s]
_DIFFERENCE = 0.025  # to either side, over which a motion is a difference [s]
_SLOWEST = 0.01  # a hand that moves less has no delay [m/s], RMS
_LEAST_FIT = 0.5  # of the tool's motion that the hand's explains


class Track(NamedTuple):
    """Where a point is over time."""

    t: Array  # (n,) [s], rising
    position: Array  # (n, 3) [m]

    def velocity(self, when: Array) -> Array:
        """(m, 3) [m/s] at times ``when`` (m,) [s], as a difference over 50 ms; before and after the track it rests."""
        ahead, behind = (
            np.stack([np.interp(when + shift, self.t, column) for column in self.position.T], axis=1)
            for shift in (_DIFFERENCE, -_DIFFERENCE)
        )
        return (ahead - behind) / (2.0 * _DIFFERENCE)


def delays(episode: Episode, hand: str) -> tuple[float | None, float | None]:
    """Delay [s] of the target, and of the measured tool, behind a hand's poses as they were received.

    It is the tau that maximises the squared correlation of v(t) with M v_hand(t - tau) over all times t at which the
    arm is engaged: v is the velocity of target or tool, M how the teleoperation maps the hand's axes to the world. So
    neither anchors nor the scale matter, nor for how long the hand rests. None: the hand moves less than 10 mm/s RMS,
    only turns, or explains less than half of that motion, as where the tool is held up; or there is no such maximum
    within (0, 0.5) s.
    """
    samples = episode.hands[hand]
    arm = episode.arms.index(samples.arm)
    usable = np.isfinite(samples.position).all(axis=1) & np.isfinite(samples.received)
    received, first = np.unique(samples.received[usable], return_index=True)
    if len(received) < 2:
        return None, None
    teleop = episode.config.teleop
    position = samples.position[usable][first] @ _axes_of(teleop.stance, teleop.axes).T
    t = episode.frame_t
    times = [
        np.arange(t[begin] + LONGEST + _DIFFERENCE, t[end - 1] - _DIFFERENCE, _STEP)
        for begin, end in stretches(episode.engaged[:, arm])
        if t[end - 1] - t[begin] > LONGEST + 0.1
    ]
    if not times:
        return None, None
    followers = [Track(t, np.nan_to_num(poses[:, arm, :3])) for poses in (episode.frames.target, episode.tools)]
    target, tool = delays_behind(Track(received, position), followers, np.concatenate(times))
    return target, tool


def delays_behind(hand: Track, followers: Sequence[Track], when: Array) -> list[float | None]:
    """Delay [s] of each of ``followers`` behind ``hand``, of times ``when`` (n,) [s]; None as of :func:`delays`."""
    lags = np.arange(0.0, LONGEST + _STEP, _STEP)
    by_hand = [hand.velocity(when - lag) for lag in lags]
    return [_best(lags, by_hand, follower.velocity(when)) for follower in followers]


def _axes_of(stance: str, axes: tuple[str, str, str]) -> Array:
    """M (3, 3)."""
    motion = RelativeMotion(stance, axes=axes)
    motion.anchor(pin.SE3.Identity(), pin.SE3.Identity())
    return np.stack([motion.target(pin.SE3(np.eye(3), axis)).translation for axis in np.eye(3)], axis=1)


def _best(lags: Array, by_hand: list[Array], moved: Array) -> float | None:
    """The delay of the highest correlation, between two steps too."""
    energy = float(np.sum(moved * moved))
    fits = np.zeros(len(lags))
    for index, hand in enumerate(by_hand):
        power, product = float(np.sum(hand * hand)), float(np.sum(hand * moved))
        if product > 0.0 and power > _SLOWEST**2 * len(hand):
            fits[index] = product * product / (power * energy)
    best = int(np.argmax(fits))
    if fits[best] < _LEAST_FIT or not 0 < best < len(lags) - 1:
        return None
    before, peak, after = fits[best - 1 : best + 2]
    bend = before - 2.0 * peak + after
    return float(lags[best] + (0.5 * _STEP * (before - after) / bend if bend < 0.0 else 0.0))
