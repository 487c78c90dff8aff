"""Identify the mass and the centre of mass of an arm's load, from torques at rest in many postures.

Let m be the mass of the last link, and c its centre of mass. At rest the torques of gravity are linear in m and in m c.
The difference between measured torques and a model therefore tells by how much m and m c differ from the model.
Published masses of an arm's links differ by up to a factor of two. If they are wrong, no load explains the torques, and
the load is not judged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.errors import RobotError
from q2r2_control.robot.pairs import LinkClass
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

LEAST_POSTURES = 8
MODEL, PENDANT = "its tool's model", "the pendant, if its load data are the model's,"
_LEAST_SPREAD = 0.2  # Least singular value of the regressor per posture, relative to g [m].
_LIGHT = 0.05  # If a mass is below this, its centre is not reported [kg].
_MASS_BOUND, _CENTRE_BOUND = 0.3, 50.0  # Greatest difference from the expected load [kg], [mm].
_EXPLAINED = 1.0  # Greatest residual with which a model of the arm is good enough [Nm].


@dataclass(frozen=True, slots=True)
class LoadReport:
    """The load that fits the torques of an arm. Centres are in the flange's frame, as on the pendant."""

    arm: str
    against: str  # The model with which the torques were compared: MODEL or PENDANT.
    identified_kg: float
    expected_kg: float
    identified_centre_mm: list[float]
    expected_centre_mm: list[float]
    residual_nm: float  # RMS of the torque that no load explains.

    @property
    def is_judged(self) -> bool:
        """Whether :meth:`check` judges the load. With MODEL it does so only if some load explains the torques."""
        return self.against == PENDANT or self.residual_nm <= _EXPLAINED

    def check(self) -> None:
        """Raise :class:`RobotError` if the load is judged and differs from the expected one."""
        away = float(np.linalg.norm(np.subtract(self.identified_centre_mm, self.expected_centre_mm)))
        wrong = abs(self.identified_kg - self.expected_kg) > _MASS_BOUND or away > _CENTRE_BOUND
        if wrong and self.is_judged:
            centre = ", ".join(f"{value:.0f}" for value in self.identified_centre_mm)
            raise RobotError(
                f"the {self.arm} arm carries {self.identified_kg:.2f} kg at {centre} mm; {self.against} has "
                f"{self.expected_kg:.2f} kg, {away:.0f} mm away; allowed: off by {_MASS_BOUND:g} kg and "
                f"{_CENTRE_BOUND:g} mm. Weigh the tool, and enter its mass and centre in the pendant's load data and "
                "in the tool's model"
            )


def identify_load(robot: Robot, arm: str, postures: Array, missing: Array, against: str) -> LoadReport:
    """Return the load of ``arm``.

    Args:
        robot: The robot.
        arm: The arm.
        postures: The postures at rest (n, nv) [rad].
        missing: The measured torques minus the torques of a model with the expected tool (n, nv) [Nm].
        against: The name of that model: MODEL for the robot's own, or PENDANT for the cabinet's.

    Raises:
        RobotError: If there are fewer than eight postures, or if they are too similar.
    """
    if len(postures) < LEAST_POSTURES:
        raise RobotError(f"{len(postures)} postures: allowed: {LEAST_POSTURES} or more")
    model, data, joints = robot.model, robot.model.createData(), robot.arms[arm].joints
    at_rest, last = np.zeros(model.nv), 10 * int(joints[-1])
    # The regressor has ten columns for each body: m, m c (3,), inertia (6,).
    regressors = [pin.computeJointTorqueRegressor(model, data, q, at_rest, at_rest).copy() for q in postures]
    A = np.concatenate([regressor[joints, last : last + 4] for regressor in regressors])
    b = missing[:, joints].ravel()
    least = np.linalg.svd(A, compute_uv=False)[-1] / np.sqrt(len(postures)) / np.linalg.norm(model.gravity.linear)
    if least < _LEAST_SPREAD:
        raise RobotError(f"the postures are too alike: spread {least:.2f}; allowed: {_LEAST_SPREAD:g} or more")
    difference = np.linalg.lstsq(A, b, rcond=None)[0]
    flange, tool = _tool_of(robot, arm)
    # The difference as a mass and its moment in the flange's frame.
    mass, moment = difference[0], flange.rotation.T @ (difference[1:] - difference[0] * flange.translation)
    known = tool.mass * tool.lever
    return LoadReport(
        arm=arm,
        against=against,
        identified_kg=float(tool.mass + mass),
        expected_kg=float(tool.mass),
        identified_centre_mm=_centre(tool.mass + mass, known + moment),
        expected_centre_mm=_centre(tool.mass, known),
        residual_nm=float(np.sqrt(np.mean((b - A @ difference) ** 2))),
    )


def _centre(mass: float, moment: Array) -> list[float]:
    """Return the centre of a ``mass`` [kg] with the ``moment`` (3,) [kg m], in [mm]; zeros for a light mass."""
    centre: list[float] = (1e3 * moment / mass).round(1).tolist() if mass > _LIGHT else [0.0, 0.0, 0.0]
    return centre


def _tool_of(robot: Robot, arm: str) -> tuple[pin.SE3, pin.Inertia]:
    """Return the pose of the flange on the last joint, and the inertia of the tool's and the fingers' links.

    The inertia is in the frame of the flange.
    """
    frames, its = robot.model.frames, robot.arms[arm]
    carried = [
        frame
        for frame in frames
        if frame.type == pin.FrameType.BODY
        and (role := robot.roles.get(frame.name)) is not None
        and role.part in (LinkClass.TOOL, LinkClass.FINGER)
        and arm in role.arms
    ]
    # These frames are needed, because Pinocchio keeps the inertia of a link in the frame of the fixed joint before it.
    mounts = [frames[frame.parentFrame] for frame in carried]
    names = {frame.name for frame in carried}
    bases = [frames[mount.parentFrame] for mount in mounts if frames[mount.parentFrame].name not in names]
    flange = (bases[0] if bases else frames[its.frame_id]).placement
    total = pin.Inertia.Zero()
    for mount in mounts:
        total += flange.actInv(mount.placement).act(mount.inertia)
    return flange, total
