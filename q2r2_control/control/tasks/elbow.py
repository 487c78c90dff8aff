"""Control the swivel of an arm's elbow about the line from shoulder to wrist: the task that YAML names ``swivel``.

Let S, E and W be the positions of shoulder, elbow and wrist, w = (W - S) / |W - S|, e = E - S, and V the unit vector
that points up. The part of e that is perpendicular to the line is p = e - (w'e) w, and the same part of V is
l = V - (w'V) w. The swivel angle is the angle from l to p about w,

    psi = atan2(w'(V x p), V'p)

(Kreutz-Delgado, Long, Seraji, Int. J. Robotics Research 11(5), 1992). With t_p = w x p / |p| and t_l = w x l / |l|,

    dpsi = t_p'de / |p| + ((w'V) / |l| t_l - (w'e) / |p| t_p)' dw',    dw' = d(W - S) / |W - S|.

The angle is not defined for a stretched arm (p = 0), nor for a wrist straight above or below the shoulder (l = 0). Near
both cases the cost decreases to 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.control.tasks.arguments import check_robot, positive
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_UP = np.array([0.0, 0.0, 1.0])
# Below these values the cost decreases to 0: |p| [m], and |l|, which is the sine of the angle between the line and V.
_FULL_RADIUS, _FULL_SINE = 0.05, 0.2
_TINY = 1e-6
_DAMPING = 1e-6  # Damping of the projection into the nullspace of the tool's motion.


class ElbowSwivel:
    """Turns elbows to wanted swivel angles, in the nullspace of the tools. The tools' motion stays the same.

    The cost of each arm is  s w (n' v - k (psi* - psi))^2.  Here psi is the swivel angle, as in the module's docstring,
    and n is its gradient, projected into the nullspace of the tool's motion. The factor s falls from 1 to 0 near the
    postures at which psi is not defined. A YAML names the task ``swivel``. Source: Kreutz-Delgado, Long, Seraji,
    Int. J. Robotics Research 11(5), 1992.

    Args:
        robot: The robot that has the arms.
        angles: Wanted angle psi* of each arm that has the task; 0 for elbow up, None for the angle at home [rad].
        joints: Names of the joints at shoulder, elbow and wrist, without the arm's prefix.
        gain: The gain k: swivel speed per angle [1/s].
        weight: The weight w, compared with 1 for a tool's error in metres.

    Raises:
        ConfigError: If an arm or a joint does not exist, or if a number is not allowed.
    """

    def __init__(
        self,
        robot: Robot,
        angles: Mapping[str, float | None],
        joints: Sequence[str] = ("A2", "A4", "A6"),
        gain: float = 2.0,
        weight: float = 0.1,
    ) -> None:
        check_robot(robot)
        self._robot, self._gain, self._weight = robot, positive("gain", gain), positive("weight", weight)
        if not isinstance(joints, list | tuple) or len(joints) != 3:
            raise ConfigError(f"joints = {joints!r:.60}: allowed: three, at shoulder, elbow and wrist")
        if not isinstance(angles, Mapping) or not angles:
            raise ConfigError(f"angles = {angles!r:.60}: allowed: an angle or null by arm, such as {{left: 0.3}}")
        for arm, angle in angles.items():
            if angle is not None and not (isinstance(angle, float | int) and abs(angle) <= math.tau):
                raise ConfigError(f"angles.{arm!s:.40} = {angle!r:.40}: allowed: -6.28 .. 6.28 rad, or null")
        self._data = robot.model.createData()
        self._joints = {arm: [_joint(robot, arm, name) for name in joints] for arm in angles}
        for arm, found in self._joints.items():
            if not found[0] < found[1] < found[2]:
                raise ConfigError(f"joints = {list(joints)!s:.60}: allowed: three of {arm} from base to tip")
        self._angles = {
            arm: self.angle(arm, robot.home) if angle is None else float(angle) for arm, angle in angles.items()
        }

    def angle(self, arm: str, q: Array) -> float:
        """Return the swivel angle of an arm at a posture ``q`` (nv,), in (-pi, pi] [rad]."""
        pin.computeJointJacobians(self._robot.model, self._data, q)
        return self._swivel(arm)[0]

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :meth:`Task.cost`."""
        nv = self._robot.model.nv
        H, g = np.zeros((nv, nv)), np.zeros(nv)
        pin.computeJointJacobians(self._robot.model, self._data, q)
        for arm, wanted in self._angles.items():
            angle, share, row = self._swivel(arm)
            frame = self._robot.arms[arm].frame_id
            J = pin.getFrameJacobian(self._robot.model, self._data, frame, pin.LOCAL_WORLD_ALIGNED)
            row = row - J.T @ np.linalg.solve(J @ J.T + _DAMPING * np.eye(6), J @ row)
            error = math.remainder(wanted - angle, 2.0 * math.pi)
            H += share * self._weight * np.outer(row, row)
            g -= share * self._weight * self._gain * error * row
        return H, g

    def _swivel(self, arm: str) -> tuple[float, float, Array]:
        """Return the angle [rad], the factor s from 0 to 1, and the gradient of the angle (nv,)."""
        model, data = self._robot.model, self._data
        joints, axes = self._joints[arm], pin.LOCAL_WORLD_ALIGNED
        S, E, W = (data.oMi[joint].translation for joint in joints)
        J_S, J_E, J_W = (pin.getJointJacobian(model, data, joint, axes)[:3] for joint in joints)
        length = math.dist(W, S)
        w, e = (W - S) / max(length, _TINY), E - S
        p, reference = e - (w @ e) * w, _UP - (w @ _UP) * w
        radius, sine = math.hypot(*p), math.hypot(*reference)
        if min(radius, sine, length) < _TINY:
            return 0.0, 0.0, np.zeros(model.nv)
        about_w = pin.skew(w)
        t_p, t_l = about_w @ p / radius, about_w @ reference / sine
        by_wrist = (w @ _UP / sine * t_l - w @ e / radius * t_p) / length
        row = t_p / radius @ (J_E - J_S) + by_wrist @ (J_W - J_S)
        share = min(radius / _FULL_RADIUS, 1.0) * min(sine / _FULL_SINE, 1.0)
        # With V = (0, 0, 1) the cross product is V x p = (-p_y, p_x, 0).
        return math.atan2(w[1] * p[0] - w[0] * p[1], p[2]), share, row


def _joint(robot: Robot, arm: str, name: str) -> int:
    """Return the index of an arm's joint in Pinocchio's model; raises :class:`ConfigError` if there is no joint."""
    if arm not in robot.arms:
        raise ConfigError(f"angles: no arm {arm!r:.40}; allowed: {', '.join(robot.arms)}")
    own = {robot.joint_names[j].removeprefix(f"{arm}_"): int(j) + 1 for j in robot.arms[arm].joints}
    if name not in [*own]:
        raise ConfigError(f"joints: {arm} has no joint {name!r:.40}; allowed: {', '.join(own)}")
    return own[name]
