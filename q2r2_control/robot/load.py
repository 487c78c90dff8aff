"""The mass and centre of mass that an arm carries, from torques that were measured while it rested in many postures.

At rest the torques that gravity asks for are linear in the mass m of the last link and in m c, c being its centre of
mass. The measured torques less those of the model therefore tell by how much m and m c differ from the model's.
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
_LEAST_SPREAD = 0.2  # smallest singular value of the regressor, a posture, relative to g [m]
_LIGHT = 0.05  # a mass that has no centre worth telling [kg]
_MASS_BOUND, _CENTRE_BOUND = 0.3, 50.0  # of the identified load to the model's [kg], [mm]


@dataclass(frozen=True, slots=True)
class LoadReport:
    """The load that fits an arm's torques beside its model's, centres in the flange's frame as the pendant has them."""

    arm: str
    identified_kg: float
    model_kg: float
    identified_centre_mm: list[float]
    model_centre_mm: list[float]
    residual_nm: float  # torque that the fit leaves, RMS

    def check(self) -> None:
        """Raises :class:`RobotError` for a load that is not the model's."""
        away = float(np.linalg.norm(np.subtract(self.identified_centre_mm, self.model_centre_mm)))
        if abs(self.identified_kg - self.model_kg) > _MASS_BOUND or away > _CENTRE_BOUND:
            centre = ", ".join(f"{value:.0f}" for value in self.identified_centre_mm)
            raise RobotError(
                f"the {self.arm} arm carries {self.identified_kg:.2f} kg at {centre} mm, and its tool's model has "
                f"{self.model_kg:.2f} kg, {away:.0f} mm away; allowed: off by {_MASS_BOUND:g} kg and {_CENTRE_BOUND:g} "
                "mm. Weigh the tool, and enter its mass and centre in the pendant's load data and in the tool's model"
            )


def identify_load(robot: Robot, arm: str, postures: Array, torques: Array) -> LoadReport:
    """The load of ``arm`` from ``torques`` (n, nv) [Nm] measured at rest in ``postures`` (n, nv) [rad].

    Raises :class:`RobotError` for fewer than eight postures, and for postures too alike to tell mass and centre apart.
    """
    if len(postures) < LEAST_POSTURES:
        raise RobotError(f"{len(postures)} postures: allowed: {LEAST_POSTURES} or more")
    model, data, joints = robot.model, robot.model.createData(), robot.arms[arm].joints
    at_rest, last = np.zeros(model.nv), 10 * int(joints[-1])
    rows, missing = [], []
    for q, tau in zip(postures, torques, strict=True):
        # Of each body: m, m c (3,), inertia (6,).
        regressor = pin.computeJointTorqueRegressor(model, data, q, at_rest, at_rest)
        rows.append(regressor[joints, last : last + 4].copy())
        missing.append((tau - pin.computeGeneralizedGravity(model, data, q))[joints])
    A, b = np.concatenate(rows), np.concatenate(missing)
    spread = (
        float(np.linalg.svd(A, compute_uv=False)[-1]) / np.sqrt(len(postures)) / np.linalg.norm(model.gravity.linear)
    )
    if spread < _LEAST_SPREAD:
        raise RobotError(f"the postures are too alike: spread {spread:.2f}; allowed: {_LEAST_SPREAD:g} or more")
    difference = np.linalg.lstsq(A, b, rcond=None)[0]
    flange, tool = _tool_of(robot, arm)
    # As a mass and its moment in the flange's frame.
    mass, moment = difference[0], flange.rotation.T @ (difference[1:] - difference[0] * flange.translation)
    known = tool.mass * tool.lever
    return LoadReport(
        arm=arm,
        identified_kg=float(tool.mass + mass),
        model_kg=float(tool.mass),
        identified_centre_mm=_centre(tool.mass + mass, known + moment),
        model_centre_mm=_centre(tool.mass, known),
        residual_nm=float(np.sqrt(np.mean((b - A @ difference) ** 2))),
    )


def _centre(mass: float, moment: Array) -> list[float]:
    """Of a ``mass`` [kg] with that ``moment`` (3,) [kg m], in [mm]."""
    centre: list[float] = (1e3 * moment / mass).round(1).tolist() if mass > _LIGHT else [0.0, 0.0, 0.0]
    return centre


def _tool_of(robot: Robot, arm: str) -> tuple[pin.SE3, pin.Inertia]:
    """Where the flange is on the last joint, and the inertia in its frame of all links that are no arm's."""
    frames, its = robot.model.frames, robot.arms[arm]
    carried = [
        frame
        for frame in frames
        if frame.type == pin.FrameType.BODY
        and (role := robot.roles.get(frame.name)) is not None
        and role.part in (LinkClass.TOOL, LinkClass.FINGER)
        and arm in role.arms
    ]
    # A link's inertia is that of the fixed joint's frame before it.
    mounts = [frames[frame.parentFrame] for frame in carried]
    names = {frame.name for frame in carried}
    bases = [frames[mount.parentFrame] for mount in mounts if frames[mount.parentFrame].name not in names]
    flange = (bases[0] if bases else frames[its.frame_id]).placement
    total = pin.Inertia.Zero()
    for mount in mounts:
        total += flange.actInv(mount.placement).act(mount.inertia)
    return flange, total
