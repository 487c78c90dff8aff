"""The operator's side of one run: the input, the teleop layer, the way home, and what is told to hands and log."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import cycle

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.inputs.base import Input
from q2r2_control.loop.arm_conditions import ArmConditions
from q2r2_control.pipeline.pending_requests import PendingRequests
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.gripper_limiter import Grip
from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import ArmTarget, HandSample, HapticFeedback
from q2r2_control.wording import event_line, sentence

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


_logger = logging.getLogger(__name__)


class OperatorSide:
    """Once a tick: :meth:`poll`, :meth:`targets`, and at its end :meth:`take_events` and ``feedback`` to the hands."""

    def __init__(
        self,
        teleop: Teleop,
        source: Input,
        supervisor: Supervisor,
        controller: CartesianController,
        requests: PendingRequests,
    ) -> None:
        self._teleop, self._input, self._supervisor, self._requests = teleop, source, supervisor, requests
        self._controller = controller
        self._homing = False  # supervision is on the way home
        self.feedback = OperatorFeedback(controller, teleop.hand_of, teleop.settings.haptics, source.send_haptic)
        self.connected = False

    def poll(self, now: float) -> list[HandSample]:
        """Samples of the hands; a connection that is lost stops the arms that hands drive."""
        was_connected = self.connected
        samples = self._input.poll(now)
        self.connected = self._input.connected
        if was_connected and not self.connected:
            self._teleop.connection_lost(now)
        return samples

    def targets(self, samples: list[HandSample], tools: Mapping[str, pin.SE3], now: float) -> dict[str, ArmTarget]:
        """The operator's targets for the arms; see :meth:`Teleop.update`."""
        if self._requests:
            self._fulfil(now)
        commanded = {arm: self._controller.tool_pose(arm) for arm in tools}
        targets = self._teleop.update(samples, tools, now, commanded)
        self._go_home(now)
        return targets

    def take_events(self, start: float) -> list[Event]:
        """Events of the arms since the last call, by the time since ``start`` [s]; they are logged."""
        events = self._teleop.take_events()
        if not events:
            return events  # as at most ticks
        events = [replace(event, t=event.t - start) for event in events]
        for event in events:
            if is_fault(event) and event.kind is not ReasonKind.RECORDING_ENDED:  # which the recorder has logged
                _logger.warning("%s arm: %s", event.arm, sentence(event.reason))
            elif _logger.isEnabledFor(logging.DEBUG):
                _logger.debug("%s arm: %s -> %s", event.arm, event.source, event_line(event))
        return events

    def _fulfil(self, now: float) -> None:
        home, settings, control = self._requests.home, self._requests.settings, self._requests.control
        for reason in self._requests.reasons(self._teleop.settings):
            self._teleop.record_event(now, reason)
        self._requests.clear()
        if home:
            self._teleop.home(now)
        if settings is not None:
            problem = self._teleop.change(settings, now)
            self._record_change(ReasonKind.SETTINGS_CHANGED, problem, now)
            if problem is None:
                self.feedback.scale(settings.haptics.strength)
        if control is not None:
            refused = self._controller.change(control)
            problem = None if refused is None else Reason.of(ReasonKind.CONTROL_REFUSED, text=refused)
            self._record_change(ReasonKind.CONTROL_CHANGED, problem, now)

    def _record_change(self, changed: ReasonKind, problem: Reason | None, now: float) -> None:
        outcome = Reason(changed) if problem is None else Reason(ReasonKind.NOT_CHANGED, cause=problem)
        self._teleop.record_event(now, outcome)

    def _go_home(self, now: float) -> None:
        """Begin and end the way home as the operator asks, and tell the operator how it ended."""
        asked, supervisor = self._teleop.homing, self._supervisor
        if asked and not self._homing:
            if refusal := supervisor.go_home():
                self._teleop.end_homing(now, Reason(ReasonKind.NOT_HOMING, cause=refusal), arrived=False)
            else:
                self._homing = True
        elif self._homing and not asked:
            self._homing = False
            supervisor.homing.end()
        elif self._homing and not supervisor.homing.active:
            self._homing = False
            outcome = supervisor.homing.outcome
            self._teleop.end_homing(now, outcome or Reason(ReasonKind.HOMING_ENDED))
