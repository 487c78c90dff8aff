"""The kinematics of a leader arm: the positions of its joints give the pose of the hand that holds it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum

import pinocchio as pin
from pydantic import Field

from q2r2_control import Array, ConfigError, InputError, StrictModel

POSITION = ".pos"  # lerobot's suffix of a joint's position in an action.
GRIPPER = f"gripper{POSITION}"  # 0 closed .. 100 open.


class Units(StrEnum):
    """What the positions of a leader's joints mean."""

    DEGREES = "degrees"  # Teleoperators with use_degrees: true.
    RANGE = "range"  # -100 .. 100 over the range of the joint, which the URDF has to limit.


class LeaderSettings(StrictModel):
    """The settings of a leader arm."""

    urdf: str = Field(min_length=1, description="path of the leader's URDF")
    tool: str = Field(min_length=1, description="frame of the URDF that the hand holds, such as gripper_frame_link")
    units: Units = Field(Units.DEGREES, description="degrees, or range for -100 .. 100")
    joints: dict[str, str] = Field(
        default_factory=dict,
        description="joint of the URDF by lerobot's name, if the names differ; -NAME turns the other way",
    )


class LeaderArm:
    """The forward kinematics of one leader.

    Args:
        settings: The settings of the leader.
        names: The names of the numbers in the teleoperator's actions.

    Raises:
        ConfigError: If the URDF cannot be read, or if it lacks a joint, a joint's limits, or the tool.
    """

    def __init__(self, settings: LeaderSettings, names: list[str]) -> None:
        self._settings = settings
        try:
            self._model = pin.buildModelFromUrdf(settings.urdf)
        except (ValueError, RuntimeError) as error:
            raise ConfigError(f"leader.urdf = {settings.urdf}: cannot be read as a URDF") from error
        self._data = self._model.createData()
        if not self._model.existFrame(settings.tool):
            raise ConfigError(f"leader.tool = {settings.tool}: no frame of {settings.urdf}")
        self._tool = self._model.getFrameId(settings.tool)
        moving = [name for name in names if name.endswith(POSITION) and name != GRIPPER]
        if not moving:
            raise ConfigError(
                f"leader: the teleoperator gives {', '.join(names)}; allowed: positions of joints, NAME.pos"
            )
        self._joints = {name: self._joint(name.removesuffix(POSITION)) for name in moving}
        given = [name.removesuffix(POSITION) for name in moving]
        if unknown := [name for name in settings.joints if name not in given]:
            raise ConfigError(
                f"leader.joints.{unknown[0]}: not such a joint of the teleoperator; allowed: {', '.join(given)}"
            )
        places = [at for at, _ in self._joints.values()]
        for name, at in zip(given, places, strict=True):
            if places.count(at) > 1:
                raise ConfigError(f"leader.joints.{name}: two joints move the same joint of the URDF; allowed: one")

    def _joint(self, name: str) -> tuple[int, float]:
        """Return the index in q of the joint that lerobot calls ``name``, and its direction."""
        given = self._settings.joints.get(name, name)
        own = given.removeprefix("-")
        joint = self._model.getJointId(own) if self._model.existJointName(own) else 0
        if not joint or self._model.joints[joint].nq != 1:
            allowed = ", ".join(self._model.names[it.id] for it in self._model.joints[1:] if it.nq == 1)
            raise ConfigError(
                f"leader.joints.{name} = {own}: not such a joint of {self._settings.urdf}; allowed: {allowed}"
            )
        at = self._model.joints[joint].idx_q
        room = self._model.upperPositionLimit[at] - self._model.lowerPositionLimit[at]
        if self._settings.units is Units.RANGE and not 0.0 < room < 4.0 * math.pi:
            raise ConfigError(f"leader.joints.{name} = {own}: the URDF gives no limits; allowed: units: degrees")
        return at, -1.0 if given.startswith("-") else 1.0

    def tool(self, action: Mapping[str, float]) -> tuple[Array, Array]:
        """Return position (3,) [m] and quaternion x y z w (4,) of the tool in the frame of the leader's base.

        Raises:
            KeyError: If a joint is missing in the ``action``.
            InputError: If its position is not a finite number.
        """
        q = pin.neutral(self._model)
        for name, (at, direction) in self._joints.items():
            value = direction * number_of(action, name)
            if self._settings.units is Units.DEGREES:
                q[at] = math.radians(value)
            else:
                lower, upper = self._model.lowerPositionLimit[at], self._model.upperPositionLimit[at]
                q[at] = lower + (value + 100.0) / 200.0 * (upper - lower)
        pin.framesForwardKinematics(self._model, self._data, q)
        pose = self._data.oMf[self._tool]
        return pose.translation.copy(), pin.Quaternion(pose.rotation).coeffs().copy()


def trigger_of(action: Mapping[str, float]) -> float:
    """Return how far the gripper's handle is pressed, from 0 for open to 1 for closed; 0 if there is no handle.

    Raises:
        InputError: If the position of the handle is not a finite number.
    """
    opening = number_of(action, GRIPPER) if GRIPPER in action else 100.0
    return min(max(1.0 - opening / 100.0, 0.0), 1.0)


def number_of(action: Mapping[str, float], name: str) -> float:
    """Return a number of a teleoperator's action.

    Raises:
        KeyError: If it is missing.
        InputError: If it is not a finite number.
    """
    if not math.isfinite(number := float(action[name])):
        raise InputError(f"{name} = {number}: allowed: a finite number")
    return number
