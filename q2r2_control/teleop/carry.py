"""Let one hand move two tools as one rigid body, for two arms that carry one box.

The hand is anchored to a frame in the middle between both tools. At the beginning, the axes of this frame are parallel
to the world's axes. Both tools keep their poses in this frame. No target jumps at the beginning, and both targets
move exactly as one rigid body, except for the small correction of :class:`RelationKeeper`. If an arm cannot follow, a
leash keeps the frame near this arm. This leash is shorter than the leash of one arm, so that the load is neither torn
nor crushed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.quaternions import Vector, floats_of, se3_of
from q2r2_control.teleop.leash import Workspace
from q2r2_control.types import LONGEST_DT, Array, Pose, pose_of

# Gain of the loop that keeps the relative pose of the tools [1/s]. A first-order loop with the delay T, here 0.07 s, is
# stable below pi / (2 T).
_GAIN = 20.0
_MAX_SHIFT = 0.01, 0.05  # Greatest distance and angle by which the loop shifts a target [m], [rad].


class CarriedTools:
    """The frame between two tools, and the constant poses of both tools in this frame."""

    def __init__(self, tools: Mapping[str, pin.SE3]) -> None:
        """``tools`` are the present poses of both tools, measured or commanded, in the world frame."""
        middle = np.mean([tool.translation for tool in tools.values()], axis=0)
        self.frame = pose_of(np.eye(3), middle)  # The target of the frame.
        self._in_frame = {arm: self.frame.actInv(tool) for arm, tool in tools.items()}

    def frames_of(self, tools: Mapping[str, pin.SE3]) -> dict[str, pin.SE3]:
        """Return, for each tool pose, the pose of the frame that belongs to it. All poses are in the world frame."""
        return {arm: tools[arm] * placed.inverse() for arm, placed in self._in_frame.items() if arm in tools}

    def slowest(self, frames: Mapping[str, pin.SE3]) -> pin.SE3 | None:
        """Return the pose of ``frames`` that is farthest from the target of the frame; None if there are none."""
        return max(frames.values(), key=self._away, default=None)

    def tool_at(self, arm: str, frame: pin.SE3) -> pin.SE3:
        """Return the pose of one tool if the frame has the pose ``frame`` (both in the world frame)."""
        return frame * self._in_frame[arm]

    def at(self, frame: pin.SE3) -> dict[str, pin.SE3]:
        """Return the poses of both tools if the frame has the pose ``frame`` (all in the world frame)."""
        return {arm: self.tool_at(arm, frame) for arm in self._in_frame}

    def _away(self, frame: pin.SE3) -> float:
        """Return an upper bound on the distance from a tool to its target if the frame has the pose ``frame`` [m]."""
        lever = max(float(np.linalg.norm(tool.translation)) for tool in self._in_frame.values())
        turn = float(np.linalg.norm(pin.log3(frame.rotation @ self.frame.rotation.T)))
        return float(np.linalg.norm(frame.translation - self.frame.translation)) + lever * turn


class RelationKeeper:
    """Shifts the target of the carried tool so that the tools, like their targets, keep their relative pose.

    Each arm lags behind its target by some millimetres, and the two lags differ. There is one frame between the tools,
    and its pose can be computed from either tool pose. The two results differ a little. A first-order loop reduces this
    difference: it adds a shift c to the frame from which the carried tool's target is computed.

        dc/dt = g (frame by the leading tool's pose - frame by the carried tool's pose),  |c| bounded.
    """

    def __init__(self) -> None:
        self._shift, self._turn = np.zeros(3), np.eye(3)
        self._now: float | None = None

    def update_shift(self, leading: pin.SE3, carried: pin.SE3, now: float) -> None:
        """Update the shift.

        Args:
            leading: Pose of the frame, computed from the leading tool's pose in the reference (world frame).
            carried: Pose of the frame, computed from the carried tool's pose in the reference (world frame).
            now: The time [s].
        """
        dt = 0.0 if self._now is None else min(max(now - self._now, 0.0), LONGEST_DT)
        self._now = now
        gain = min(_GAIN * dt, 1.0)
        self._shift = _at_most(self._shift + gain * (leading.translation - carried.translation), _MAX_SHIFT[0])
        turn = pin.log3(pin.exp3(gain * pin.log3(leading.rotation @ carried.rotation.T)) @ self._turn)
        self._turn = pin.exp3(_at_most(turn, _MAX_SHIFT[1]))

    def frame(self, asked: pin.SE3) -> pin.SE3:
        """Return the target of the carried tool's frame. ``asked`` is the target of the leading tool's frame."""
        return pose_of(self._turn @ asked.rotation, asked.translation + self._shift)


def _at_most(vector: Array, length: float) -> Array:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)


class CarriedWorkspace:
    """Keeps both tools in the workspaces of their arms, by shifting the frame between them."""

    def __init__(self, tools: CarriedTools, boxes: Mapping[str, Workspace]) -> None:
        self._tools, self._boxes = tools, boxes
        self.reset()

    def reset(self) -> None:
        self.slip = 0.0  # Length of the hand's motion that the frame has not followed since the reset [m].
        for box in self._boxes.values():
            box.reset()

    def hold(self, frame: Pose) -> Vector | None:
        """Return the permitted position (world frame) for the target ``frame`` [m]; None if ``frame`` is permitted.

        See :meth:`Workspace.hold`.
        """
        shift = np.zeros(3)
        tools = {arm: floats_of(tool) for arm, tool in self._tools.at(se3_of(frame)).items()}
        for arm, box in self._boxes.items():
            if (held := box.hold(tools[arm])) is not None:
                back = np.subtract(held, tools[arm][0])
                shift = np.where(np.abs(back) > np.abs(shift), back, shift)
        if not shift.any():
            return None
        self.slip += float(np.linalg.norm(shift))
        x, y, z = (frame[0] + shift).tolist()
        return x, y, z
