"""Vibrations of a run: each arm's state, nearness, contact, and limits."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import numpy as np

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.loop.arm_conditions import ArmConditions
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.grasp_watch import Grip
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.types import HapticFeedback

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

    def update(self, tick: Tick) -> None:
        """Send the vibrations of one tick."""
        now = tick.now
        for event in tick.events:
            self._pulses[event.arm].tell(event)
        self._conditions.note(tick.reference.report, now)
        self._due = max(self._due, now - _PERIOD + self._wait)  # each arm once at most
        while now >= self._due:
            self._due += self._wait
            self._inspect(next(self._turns), tick)
        for arm, pulses in self._pulses.items():
            if (feedback := pulses.at(now, self._hand_of(arm))) is not None:
                self._send(feedback)

    def _inspect(self, arm: str, tick: Tick) -> None:
        pulses, target = self._pulses[arm], tick.targets[arm]
        pulses.slip(target.slip, target.slip_angle)
        pulses.notice(self._conditions.look_at(arm, tick.state, tick.now))
        commanded, opening = tick.command.grippers.get(arm), tick.openings.get(arm)
        if commanded is not None and opening is not None:
            pulses.grasps(self._grips[arm].look(commanded, opening, tick.now))
