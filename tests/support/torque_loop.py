"""A loop in which an impedance controller moves a plant by torques. Each tick asserts the bounds of the torques."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.impedance import ImpedanceController, TorqueCommand
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, Reference, StepReport, StepStatus


def pose_error(wanted: pin.SE3, pose: pin.SE3) -> Array:
    """Return ``wanted`` minus ``pose`` (6,): position [m] and rotation vector [rad], in world axes."""
    return np.concatenate([wanted.translation - pose.translation, pin.log3(wanted.rotation @ pose.rotation.T)])


DT = 0.001
_ROUNDING = 1e-9  # Tolerance for rounding errors [Nm].
_NO_REPORT = StepReport(StepStatus.OK, (), (), ("", ""), np.inf, True, False, 0.0, 0.0)


def reference(q: Array, v: Array | None = None, a: Array | None = None) -> Reference:
    """Return a reference that no controller has computed. It rests if ``v`` and ``a`` are left out."""
    zero = np.zeros_like(q)
    return Reference(q, zero if v is None else v, zero if a is None else a, _NO_REPORT)


class TorqueLoop:
    """A run with a tick of ``dt`` [s]. It starts at rest at the posture ``q`` (nv,), which is also the reference."""

    def __init__(self, plant: MujocoPlant, robot: Robot, settings: ImpedanceSettings, q: Array, dt: float = DT) -> None:
        self.dt = dt
        self.plant, self.robot, self.settings = plant, robot, settings
        self.controller = ImpedanceController(robot, settings)
        self.reference = reference(q)
        self.start = {arm: robot.tool_pose(q, arm) for arm in robot.arms}
        self._limit = settings.torque_scale * robot.torque_limit
        self._change = settings.torque_rate_limit * dt
        plant.reset(q)
        self.state = plant.state()
        self.controller.reset(self.state)
        self._last: Array = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)

    def tick(self) -> TorqueCommand:
        """Do one tick, and assert the bounds on each torque and on its change."""
        command = self.controller.step(self.reference, self.state, self.dt)
        # A torque that is not finite fails these assertions as well.
        assert (np.abs(command.tau) <= self._limit).all()
        assert np.abs(command.tau - self._last).max() <= self._change + _ROUNDING
        assert not command.report.held
        self._last = command.tau
        self.plant.apply(Command(CommandMode.TORQUE, self.reference.q, self.reference.v, command.tau, {}))
        self.plant.advance(self.dt)
        self.state = self.plant.state()
        assert (self.state.tau == command.tau).all(), "the plant has nothing to clip"
        return command

    def ticks(self, duration: float) -> Iterator[TorqueCommand]:
        """Yield ticks for ``duration`` [s]."""
        for _ in range(round(duration / self.dt)):
            yield self.tick()

    def run(self, duration: float) -> None:
        """Tick for ``duration`` [s]."""
        for _ in self.ticks(duration):
            pass

    def settle(self, timeout: float = 8.0) -> None:
        """Tick until all joints rest. Raises :class:`AssertionError` after ``timeout`` [s]."""
        for _ in self.ticks(timeout):
            if np.abs(self.state.v).max() < 3e-4 and self.state.stamp > 0.3:
                return
        raise AssertionError(f"still {np.abs(self.state.v).max():.2e} rad/s after {timeout:g} s")

    def displacement(self, arm: str = "left") -> Array:
        """Return the displacement (6,) [m, rad] of the tool from the start of the run, in world axes."""
        return pose_error(self.robot.tool_pose(self.state.q, arm), self.start[arm])


def left_arm(robot: Robot, q: Array) -> tuple[Array, Array]:
    """Return the Jacobian (6, 7) and inertia (7, 7) of the left arm."""
    data, arm = robot.model.createData(), robot.arms["left"]
    pin.computeJointJacobians(robot.model, data, q)
    J = pin.getFrameJacobian(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, arm.joints]
    return J, pin.crba(robot.model, data, q)[np.ix_(arm.joints, arm.joints)]
