"""What the hands feel of a run: each arm's state, what it comes near to or touches, and what holds it up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.supervision.grasp_watch import Grip
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.types import ArmTarget, Event, HapticFeedback, RobotState, StepReport

_PERIOD = 0.02  # of looking at more than events [s]
_DAMPING = 1e-4  # of a wrench's estimate where a posture is singular [m^2]
_LIMIT_LASTS = 0.5  # a joint counts as at its limit for so long after it last was: limits bind on and off [s]
_LIMIT = " position"  # ends the names of position limits in a report


class OperatorFeedback:
    """Makes the vibrations of all hands, tick by tick. Times are the loop's [s]."""

    def __init__(
        self,
        controller: CartesianController,
        hand_of: Callable[[str], str],
        settings: HapticSettings,
        send: Callable[[HapticFeedback], None],
    ) -> None:
        """``hand_of``: tells which hand drives an arm, which may change; ``send``: takes what a hand shall feel,
        and never waits.
        """
        robot = controller.robot
        self._controller, self._robot, self._send, self._hand_of = controller, robot, send, hand_of
        self._data = robot.model.createData()
        self._pulses = {arm: HapticPulses(settings) for arm in robot.arms}
        self._joints = {arm: {robot.joint_names[j] for j in robot.arms[arm].joints} for arm in robot.arms}
        self._grips = {arm: Grip(robot.arms[arm].stroke) for arm in robot.arms}
        self._limited: dict[str, float] = {}  # when a joint last was at its position limit [s]
        self._due = -np.inf

    def scale(self, strength: float) -> None:
        """Make all vibrations this strong from now on, 0..1."""
        for pulses in self._pulses.values():
            pulses.strength = strength

    def update(
        self,
        now: float,
        events: Iterable[Event],
        targets: Mapping[str, ArmTarget],
        report: StepReport,
        state: RobotState,
        grippers: Mapping[str, float],
        openings: Mapping[str, float],
    ) -> None:
        """Look at one tick: ``grippers`` are commanded openings, ``openings`` those measured."""
        for event in events:
            self._pulses[event.arm].tell(event)
        for name in report.binding:
            if name.endswith(_LIMIT):
                self._limited[name.removesuffix(_LIMIT)] = now
        if now >= self._due:
            self._due = now + _PERIOD
            self._limited = {name: t for name, t in self._limited.items() if now - t <= _LIMIT_LASTS}
            self._look(now, targets, grippers, openings)
            self._feel_contact(state)
        for arm, pulses in self._pulses.items():
            if (feedback := pulses.at(now, self._hand_of(arm))) is not None:
                self._send(feedback)

    def _look(
        self,
        now: float,
        targets: Mapping[str, ArmTarget],
        grippers: Mapping[str, float],
        openings: Mapping[str, float],
    ) -> None:
        for arm, pulses in self._pulses.items():
            pulses.slip(targets[arm].slip, targets[arm].slip_angle)
            pulses.near(self._controller.spare_distance(arm))
            pulses.limits(self._joints[arm] & self._limited.keys())
            if arm in grippers and arm in openings:
                pulses.grasps(self._grips[arm].look(grippers[arm], openings[arm], now))

    def _feel_contact(self, state: RobotState) -> None:
        if state.tau_external is None or not np.isfinite((state.tau_external, state.q)).all():
            return
        for arm, pulses in self._pulses.items():
            members = self._robot.arms[arm]
            jacobian = pin.computeFrameJacobian(
                self._robot.model, self._data, state.q, members.frame_id, pin.LOCAL_WORLD_ALIGNED
            )
            jacobian = jacobian[:, members.joints]
            square = jacobian @ jacobian.T + _DAMPING * np.eye(6)
            wrench = np.linalg.solve(square, jacobian @ state.tau_external[members.joints])
            pulses.contact(float(np.linalg.norm(wrench[:3])))
