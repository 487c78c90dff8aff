"""Two tools that one hand moves as one body, about the point between them: two arms that carry one box.

The hand is anchored to a frame in the middle between both tools, turned as the world, and both tools keep their poses
in it. Nothing jumps when it begins, and the targets' relation is exact while it lasts. Where an arm is held up, the
frame waits for it on a leash that is shorter than that of one arm. The load is then neither torn nor crushed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.quaternions import Vector, floats_of, se3_of
from q2r2_control.teleop.leash import Workspace
from q2r2_control.types import LONGEST_DT, Array, Pose, pose_of

_GAIN = 20.0  # of keeping the relation [1/s]: a first-order loop is stable below pi/(2 T), late by T, here 0.07 s
_MOST = 0.01, 0.05  # that it shifts a target by [m], [rad]


class CarriedTools:
    """The tools of both arms, as parts of one frame that moves."""

    def __init__(self, tools: Mapping[str, pin.SE3]) -> None:
        """``tools``: where both are now, or are asked to be; world frame."""
        middle = np.mean([tool.translation for tool in tools.values()], axis=0)
        self.frame = pose_of(np.eye(3), middle)  # where it is asked to be
        self._in_frame = {arm: self.frame.actInv(tool) for arm, tool in tools.items()}

    def frames_of(self, tools: Mapping[str, pin.SE3]) -> dict[str, pin.SE3]:
        """Where each of ``tools`` has the frame."""
        return {arm: tools[arm] * placed.inverse() for arm, placed in self._in_frame.items() if arm in tools}

    def slowest(self, frames: Mapping[str, pin.SE3]) -> pin.SE3 | None:
        """Of frames that disagree the one that is farther from where it is asked to be."""
        return max(frames.values(), key=self._away, default=None)

    def tool_at(self, arm: str, frame: pin.SE3) -> pin.SE3:
        """One tool, with the frame at ``frame``."""
        return frame * self._in_frame[arm]

    def at(self, frame: pin.SE3) -> dict[str, pin.SE3]:
        """Both tools, with the frame at ``frame``."""
        return {arm: self.tool_at(arm, frame) for arm in self._in_frame}

    def _away(self, frame: pin.SE3) -> float:
        """How far a frame is, as a tool feels it [m]."""
        lever = max(float(np.linalg.norm(tool.translation)) for tool in self._in_frame.values())
        turn = float(np.linalg.norm(pin.log3(frame.rotation @ self.frame.rotation.T)))
        return float(np.linalg.norm(frame.translation - self.frame.translation)) + lever * turn


class RelationKeeper:
    """Moves the frame of the tool that is carried so that both tools keep their relation, not only their targets.

    Each arm follows its target some millimetres late, in its own way. The carried one's frame is shifted by c,

        dc/dt = g (frame of the leading tool - frame of the carried tool),  |c| bounded:  a loop of first order.
    """

    def __init__(self) -> None:
        self._shift, self._turn = np.zeros(3), np.eye(3)
        self._now: float | None = None

    def update_shift(self, leading: pin.SE3, carried: pin.SE3, now: float) -> None:
        """Where the controller's reference has the frame of either tool at ``now`` [s], world frame."""
        dt = 0.0 if self._now is None else min(max(now - self._now, 0.0), LONGEST_DT)
        self._now = now
        gain = min(_GAIN * dt, 1.0)
        self._shift = _at_most(self._shift + gain * (leading.translation - carried.translation), _MOST[0])
        turn = pin.log3(pin.exp3(gain * pin.log3(leading.rotation @ carried.rotation.T)) @ self._turn)
        self._turn = pin.exp3(_at_most(turn, _MOST[1]))

    def frame(self, asked: pin.SE3) -> pin.SE3:
        """The frame for the carried tool, where ``asked`` is that of the leading one."""
        return pose_of(self._turn @ asked.rotation, asked.translation + self._shift)


def _at_most(vector: Array, length: float) -> Array:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)


class CarriedWorkspace:
    """Keeps both tools in the boxes of their arms, by moving the frame."""

    def __init__(self, tools: CarriedTools, boxes: Mapping[str, Workspace]) -> None:
        self._tools, self._boxes = tools, boxes
        self.reset()

    def reset(self) -> None:
        self.slip = 0.0  # how much of the hand's way was not made [m]
        for box in self._boxes.values():
            box.reset()

    def hold(self, frame: Pose) -> Vector | None:
        """Where the frame that is asked to be at ``frame`` may be; None: there. See :meth:`Workspace.hold`."""
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
