"""Turn the action chunks of a policy into targets of one arm, on one time line.

A chunk is followed from the time of its first action, or at once if this time has passed. It then replaces all older
chunks. Positions between two actions are cubic in time, and rotations turn at constant speed. If two chunks differ at
the moment of the change, the difference fades out, so that the target does not jump. Chunks of motions have no such
difference, because they begin at the present target. The last action stays valid for :data:`SILENT`. Then the arm
rests, because a policy that sends nothing has failed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import CommonReason, Reason
from q2r2_control.quaternions import Vector, floats_of, normalized, rotation_of, se3_of, turn_between, turned_by
from q2r2_control.teleop.leash import Leash, Workspace
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActionChunk, Array, Pose

SILENT = 0.5  # The last action of a plan stays valid for this time [s]. Then the arm rests.
_FADING = 0.5, 2.0  # Greatest speed at which the difference between two chunks fades [m/s], [rad/s].
# If a time of a chunk is farther than this from now, another clock has stamped the chunk [s].
_AHEAD = 10.0


class _Plan(NamedTuple):
    """The part of a chunk that concerns one arm."""

    start: float  # Time from which the plan is followed [s].
    chunk: ActionChunk
    times: list[float]  # Times of the poses [s].
    # Poses in the world frame. A chunk of motions has poses relative to the tool pose where the first motion begins.
    poses: list[Pose]
    grippers: list[float]  # Openings of the gripper; empty if the policy does not command it.

    @property
    def end(self) -> float:
        return self.times[-1] + SILENT


class PolicyMotion:
    """Follows the actions of a policy with one arm. All times are of the loop's clock [s]."""

    def __init__(self, arm: str, settings: TeleopSettings) -> None:
        self._arm = arm
        self._plans: list[_Plan] = []  # The plans that have not begun, in order of time.
        self._plan: _Plan | None = None  # The plan that the arm follows; None if it follows none.
        self.configure(settings)

    def configure(self, settings: TeleopSettings) -> None:
        self._settings = settings
        self._leash = Leash(settings.leash)
        self._workspace = Workspace(settings.workspace.get(self._arm))  # type: ignore[call-overload]

    @property
    def following(self) -> bool:
        """Whether the arm follows a plan."""
        return self._plan is not None

    def forget(self) -> None:
        """Forget all plans."""
        self._plans.clear()
        self._plan = None

    def receive(self, chunk: ActionChunk, now: float) -> Reason | None:
        """Take a chunk that has come at ``now``, and return why it cannot be used; None if it can.

        A chunk whose actions are all in the past is ignored.
        """
        if self._arm not in chunk.tools and self._arm not in chunk.motions:
            return None
        times = chunk.times.tolist()
        farthest = max(times[0] - now, times[-1] - now, key=abs)
        if abs(farthest) > _AHEAD:
            text = f"a time is {farthest:.3g} s from now; allowed: {_AHEAD:g} s at most, on the loop's clock"
            return Reason.of(CommonReason.POLICY_UNUSABLE, text=text)
        if self._arm in chunk.tools:
            poses = [_pose(numbers) for numbers in chunk.tools[self._arm].tolist()]
        else:
            poses = _added_up(chunk.motions[self._arm].tolist())
            if len(times) == 1:  # A single motion that comes late begins now. Otherwise its first part would be lost.
                times[0] = max(times[0], now)
            times.append(times[-1] + chunk.period)
        if jump := self._jump(times, poses):
            return jump
        grippers = chunk.grippers[self._arm].tolist() if self._arm in chunk.grippers else []
        plan = _Plan(max(times[0], now), chunk, times, poses, grippers)
        if plan.end > now:
            plans = [other for other in self._plans if other.start < plan.start] + [plan]
            due = sum(other.start <= now for other in plans)
            self._plans = plans[max(due - 1, 0) :]
        return None

    def _jump(self, times: list[float], poses: list[Pose]) -> Reason | None:
        """Return a fault if two successive actions are farther apart than the gate lets a hand move, else None."""
        gate = self._settings.gate
        for (before, start), (after, end) in pairwise(zip(times, poses, strict=True)):
            distance, angle = math.dist(start[0], end[0]), math.hypot(*turn_between(start[1], end[1]))
            most = min(gate.max_jump, gate.max_speed * (after - before))
            most_angle = min(gate.max_rotation_jump, gate.max_angular_speed * (after - before))
            if distance > most or angle > most_angle:
                return _jumped(distance, angle, "the one before", most, most_angle)
        return None

    def counts(self, now: float) -> bool:
        """Return whether there is a plan for ``now`` that the arm may begin to follow."""
        return any(plan.start <= now < plan.end for plan in self._plans)

    def begin(self, tool: Pose, now: float) -> Reason | None:
        """Begin to follow the newest plan that is due.

        Args:
            tool: The tool pose (world frame).
            now: The time [s].

        Returns:
            Why the arm cannot begin; None if it has begun.
        """
        self._plan = None
        self._workspace.reset()
        return self.advance(tool, now)

    def advance(self, tool: Pose | None, now: float) -> Reason | None:
        """Change to the plan that is due at ``now``.

        If something keeps the arm from following, the leash keeps the target near the tool. A new chunk may begin at
        this target, or at the pose to which the last chunk would have led.

        Args:
            tool: The tool pose at the controller's reference (world frame); None if not known.
            now: The time [s].

        Returns:
            Why the arm can follow no plan; None if it follows one.
        """
        due = [plan for plan in self._plans if plan.start <= now]
        self._plans = self._plans[len(due) :]
        if due:
            plan, starts = due[-1], [tool] if tool is not None else []
            if self._plan is not None:
                starts = [self.target(tool, now), self._at(now)]
            if jump := self._change(plan, starts, now):
                return jump
        if self._plan is None or now >= self._plan.end:
            return Reason.of(TeleopReason.POLICY_SILENT, timeout=SILENT)
        return None

    def _change(self, plan: _Plan, starts: list[Pose], now: float) -> Reason | None:
        """Follow ``plan`` from now on. Return why this is not possible, or None.

        The target begins at one of the poses ``starts`` (world frame): at the pose that is nearest to the plan. A plan
        of motions begins at the first pose of ``starts``.
        """
        if self._arm in plan.chunk.motions:
            plan = plan._replace(poses=_moved_to(starts[0], _interpolated(plan, now), plan.poses))
        planned, turned = _interpolated(plan, now)
        position, rotation = min(starts, key=lambda start: math.dist(start[0], planned))
        (x, y, z), (at_x, at_y, at_z) = planned, position
        self._shift, self._turn = (at_x - x, at_y - y, at_z - z), turn_between(turned, rotation)
        distance, angle = math.hypot(*self._shift), math.hypot(*self._turn)
        leash, gate = self._settings.leash, self._settings.gate
        most, most_angle = leash.distance or gate.max_jump, leash.angle or gate.max_rotation_jump
        if distance > most or angle > most_angle:
            what = "the tool" if self._plan is None else "where the one before led"
            return _jumped(distance, angle, what, most, most_angle)
        self._plan, self._began = plan, now
        self._fades = max(plan.chunk.period, distance / _FADING[0], angle / _FADING[1])
        return None

    def _at(self, now: float) -> Pose:
        """Return the plan's pose at ``now``, plus the part of the jump at the plan's start that has not faded yet."""
        assert self._plan is not None
        (x, y, z), rotation = _interpolated(self._plan, now)
        left = 1.0 - min((now - self._began) / self._fades, 1.0)
        if left == 0.0:
            return (x, y, z), rotation
        (shift_x, shift_y, shift_z), (a, b, c) = self._shift, self._turn
        return (x + left * shift_x, y + left * shift_y, z + left * shift_z), turned_by(
            rotation, (left * a, left * b, left * c)
        )

    def target(self, tool: Pose | None, now: float) -> Pose:
        """Return the target pose of the tool (world frame), within its workspace and its leash.

        Args:
            tool: The tool pose at the controller's reference (world frame); None if not known. There is then no leash.
            now: The time [s].
        """
        target = self._at(now)
        if (held := self._workspace.hold(target)) is not None:
            target = held, target[1]
        return target if tool is None else self._leash.hold(target, tool)

    def gripper(self, now: float) -> float | None:
        """Return the opening of the newest action up to ``now``; None if the policy does not command the gripper."""
        if self._plan is None or not self._plan.grippers:
            return None
        index = bisect_right(self._plan.times, now) - 1
        return self._plan.grippers[min(max(index, 0), len(self._plan.grippers) - 1)]

    def posture(self, now: float) -> Array | None:
        """Return the joint positions that the actions ask for at ``now`` (nv,) [rad]; None if they ask for none."""
        if self._plan is None or self._plan.chunk.postures is None:
            return None
        postures, (index, share) = self._plan.chunk.postures, _segment_at(self._plan.times, now)
        after = postures[min(index + 1, len(postures) - 1)]
        return np.asarray(postures[index] + share * (after - postures[index]))


def _jumped(distance: float, angle: float, what: str, allowed: float, allowed_angle: float) -> Reason:
    detail = {"distance": distance, "angle": angle, "what": what, "allowed": allowed, "allowed_angle": allowed_angle}
    return Reason(TeleopReason.POLICY_JUMPED, detail)


def _pose(numbers: list[float]) -> Pose:
    x, y, z, *rotation = numbers
    a, b, c, w = rotation
    return (x, y, z), normalized((a, b, c, w))


def _added_up(motions: list[list[float]]) -> list[Pose]:
    """Return the first pose and the pose after each motion, relative to the first pose."""
    at = pin.SE3.Identity()
    poses = [floats_of(at)]
    for x, y, z, a, b, c in motions:
        at = at * se3_of(((x, y, z), rotation_of((a, b, c))))
        poses.append(floats_of(at))
    return poses


def _moved_to(goal: Pose, origin: Pose, poses: list[Pose]) -> list[Pose]:
    """Return ``poses`` after the one rigid motion that moves the pose ``origin`` to the pose ``goal``."""
    move = se3_of(goal) * se3_of(origin).inverse()
    return [floats_of(move * se3_of(pose)) for pose in poses]


def _segment_at(times: list[float], t: float) -> tuple[int, float]:
    """Return the index of the last action up to ``t``, and the share of the time to the next action that has passed."""
    index = min(max(bisect_right(times, t) - 1, 0), max(len(times) - 2, 0))
    if len(times) == 1:
        return 0, 0.0
    return index, min(max((t - times[index]) / (times[index + 1] - times[index]), 0.0), 1.0)


def _interpolated(plan: _Plan, t: float) -> Pose:
    """Return the pose of a plan at ``t``.

    Positions are a cubic Hermite spline through all actions, with the mean velocity of the neighbours at each action.
    Rotations turn at constant speed from action to action.
    """
    times, poses = plan.times, plan.poses
    index, share = _segment_at(times, t)
    if len(times) == 1:
        return poses[0]
    (start, rotation), (end, turned) = poses[index], poses[index + 1]
    h, rest = times[index + 1] - times[index], 1.0 - share
    before, after = _velocity(times, poses, index), _velocity(times, poses, index + 1)
    x, y, z = (
        rest * rest * (1.0 + 2.0 * share) * p
        + share * share * (3.0 - 2.0 * share) * q
        + h * share * rest * (rest * u - share * v)
        for p, q, u, v in zip(start, end, before, after, strict=True)
    )
    a, b, c = turn_between(rotation, turned)
    return (x, y, z), turned_by(rotation, (share * a, share * b, share * c))


def _velocity(times: list[float], poses: list[Pose], index: int) -> Vector:
    """Return the velocity at an action: the mean velocity from the previous action to the next one [m/s]."""
    first, last = max(index - 1, 0), min(index + 1, len(times) - 1)
    h, start, end = times[last] - times[first], poses[first][0], poses[last][0]
    return (end[0] - start[0]) / h, (end[1] - start[1]) / h, (end[2] - start[2]) / h
