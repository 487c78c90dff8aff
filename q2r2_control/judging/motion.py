"""How well the arms followed, and whether they moved at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from q2r2_control.judging.delay import delays
from q2r2_control.judging.episode import Episode, Flags
from q2r2_control.judging.smoothness import smoothness
from q2r2_control.types import Array

_LOOK = 0.5  # what moves is elsewhere so much earlier or later [s]
_MOVED, _TURNED = 2e-3, 0.02  # at least [m, rad]


@dataclass(frozen=True, slots=True)
class ArmFigures:
    """One arm, over the time for which it is engaged; None: there is nothing to tell it by."""

    engaged_s: float
    position_error_mm_rms: float | None  # target to measured tool
    position_error_mm_p99: float | None
    rotation_error_deg_rms: float | None
    rotation_error_deg_p99: float | None
    hand_to_target_ms: float | None
    hand_to_tool_ms: float | None
    rejected_share: float | None  # of the ticks: the target was not usable
    leashed_share: float | None  # of the ticks: the leash dragged the target
    slip_mm: float  # by how much, in all
    slip_deg: float
    ldlj: float | None
    gripper_changes: int  # of the opening that is wanted


def arm_figures(episode: Episode, arm: str) -> ArmFigures:
    """Figures of an arm; delays and smoothness are those of :func:`delays` and :func:`smoothness`."""
    index = episode.arms.index(arm)
    ticks = episode.ticks
    engaged = ticks.engaged[:, index] & ticks.following
    errors = tracking_errors(episode, index)
    position, rotation = (error[np.isfinite(error)] for error in errors)
    hand = next(hand for hand, samples in episode.hands.items() if samples.arm == arm)
    to_target, to_tool = delays(episode, hand)
    slips = [_rise(slip[:, index], engaged) for slip in (ticks.slip, ticks.slip_angle)]
    ldlj = smoothness(episode.frame_t, episode.tools[:, index, :3], episode.engaged[:, index])
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
        ldlj=ldlj,
        gripper_changes=int((np.diff(ticks.gripper[ticks.following, index]) != 0.0).sum()),
    )


def tracking_errors(episode: Episode, arm: int) -> tuple[Array, Array]:
    """(m,) distance [m] and angle [rad] of the measured tool from the target at the frames; NaN while not engaged."""
    tools, targets = episode.tools[:, arm], episode.frames.target[:, arm]
    position = np.linalg.norm(tools[:, :3] - targets[:, :3], axis=1)
    rotation = _angles(tools[:, 3:], targets[:, 3:])
    engaged = episode.engaged[:, arm]
    return np.where(engaged, position, np.nan), np.where(engaged, rotation, np.nan)


def idle_share(episode: Episode) -> float | None:
    """Share of the run, until it begins to end, in which no arm is engaged or none of those moves.

    An arm moves where its tool, at the controller's reference, is more than 2 mm or 0.02 rad from where it was half a
    second earlier or is half a second later, or its gripper is told to open or close in that time. So neither a hand
    that trembles nor a stop between two motions counts. None: no tick is in the file.
    """
    moving = np.zeros(len(episode.frame_t), dtype=bool)
    for arm in range(len(episode.arms)):
        moving |= episode.engaged[:, arm] & _moves(episode, arm)
    following = episode.ticks.following[episode.frames.at]
    if not following.any():
        return None
    return float(1.0 - moving[following].mean())


def _moves(episode: Episode, arm: int) -> Flags:
    t, poses = episode.frame_t, episode.frames.reference[:, arm]
    gripper = episode.ticks.gripper[episode.frames.at, arm]
    moves = np.zeros(len(t), dtype=bool)
    for shift in (-_LOOK, _LOOK):
        other = np.clip(np.searchsorted(t, t + shift), 0, max(len(t) - 1, 0))
        moves |= np.linalg.norm(poses[other, :3] - poses[:, :3], axis=1) > _MOVED
        moves |= _angles(poses[other, 3:], poses[:, 3:]) > _TURNED
        moves |= gripper[other] != gripper
    return moves


def _angles(a: Array, b: Array) -> Array:
    """(n,) between rotations given as quaternions (n, 4) [rad]."""
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(np.sum(a * b, axis=1)), 0.0, 1.0)))


def _rise(values: Array, engaged: Flags) -> Array:
    """(n,) by how much ``values`` rise from one tick to the next, in both of which the arm is engaged."""
    rise = np.diff(values, prepend=values[:1])
    return np.where(engaged & np.concatenate(([False], engaged[:-1])), np.maximum(rise, 0.0), 0.0)[: len(values)]


def _share(flags: Flags, among: Flags) -> float | None:
    return float(flags[among].mean()) if among.any() else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _p99(values: Array) -> float | None:
    return float(np.percentile(values, 99)) if len(values) else None
