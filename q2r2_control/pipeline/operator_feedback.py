"""What the hands feel of a run: each arm's state, what it comes near to or touches, and what holds it up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import cycle

import numpy as np

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Event
from q2r2_control.loop.arm_conditions import ArmConditions
from q2r2_control.supervision.grasp_watch import Grip
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.types import ArmTarget, HapticFeedback, RobotState, StepReport

_PERIOD = 0.02  # of looking at more of an arm than its events [s]


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
        self._send, self._hand_of = send, hand_of
        self._conditions = ArmConditions(controller)
        self._pulses = {arm: HapticPulses(settings) for arm in robot.arms}
        self._grips = {arm: Grip(robot.arms[arm].stroke) for arm in robot.arms}
        # One arm after the other: both in one tick would make that tick a long one.
        self._turns, self._wait = cycle(robot.arms), _PERIOD / len(robot.arms)
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
        self._conditions.note(report, now)
        self._due = max(self._due, now - _PERIOD + self._wait)  # each arm once at most
        while now >= self._due:
            self._due += self._wait
            self._look(next(self._turns), now, targets, state, grippers, openings)
        for arm, pulses in self._pulses.items():
            if not pulses.idle and (feedback := pulses.at(now, self._hand_of(arm))) is not None:
                self._send(feedback)

    def _look(
        self,
        arm: str,
        now: float,
        targets: Mapping[str, ArmTarget],
        state: RobotState,
        grippers: Mapping[str, float],
        openings: Mapping[str, float],
    ) -> None:
        pulses = self._pulses[arm]
        pulses.slip(targets[arm].slip, targets[arm].slip_angle)
        pulses.notice(self._conditions.look_at(arm, state, now))
        if arm in grippers and arm in openings:
            pulses.grasps(self._grips[arm].look(grippers[arm], openings[arm], now))
