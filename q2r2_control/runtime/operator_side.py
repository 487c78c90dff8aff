"""The operator's side of one run: the input, the teleop layer, the way home, and what is told to hands and log."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.inputs.base import Input
from q2r2_control.runtime.operator_feedback import OperatorFeedback
from q2r2_control.runtime.pending_requests import PendingRequests
from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.teleop.episode_marks import RECORDING_ENDED
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import ArmTarget, Event, HandSample

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

    def targets(
        self,
        samples: list[HandSample],
        tools: Mapping[str, pin.SE3],
        now: float,
        commanded: Mapping[str, pin.SE3],
    ) -> dict[str, ArmTarget]:
        """What the operator asks of the arms, handed over to supervision; see :meth:`Teleop.update`."""
        if self._requests:
            self._fulfil(now)
        targets = self._teleop.update(samples, tools, now, commanded)
        for arm, target in targets.items():
            command = target.command
            if command is None:
                self._supervisor.release_target(arm)
            elif refusal := self._supervisor.take_target(arm, command, now, measured=tools[arm]):
                self._teleop.pause(now, refusal.line)  # or the operator would think that the arm follows
        self._go_home(now)
        return targets

    def take_events(self, start: float) -> list[Event]:
        """What happened to the arms' states since the last call, by the time since ``start`` [s]; it is logged."""
        events = self._teleop.take_events()
        if not events:
            return events  # as at most ticks
        events = [replace(event, t=event.t - start) for event in events]
        for event in events:
            if is_fault(event) and not event.reason.startswith(RECORDING_ENDED):  # which the recorder has logged
                _logger.warning("%s arm: %s", event.arm, event.reason)
            else:
                _logger.debug("%s arm: %s -> %s: %s", event.arm, event.source, event.destination, event.reason)
        return events

    def _fulfil(self, now: float) -> None:
        home, settings, control = self._requests.home, self._requests.settings, self._requests.control
        for line in self._requests.told(self._teleop.settings):
            self._teleop.tell(now, line)
        self._requests.clear()
        if home:
            self._teleop.home(now)
        if settings is not None:
            problem = self._teleop.change(settings, now)
            self._tell_change("settings", problem, now)
            if problem is None:
                self.feedback.scale(settings.haptics.strength)
        if control is not None:
            self._tell_change("control", self._controller.change(control), now)

    def _tell_change(self, what: str, problem: str | None, now: float) -> None:
        self._teleop.tell(now, f"{what} changed" if problem is None else f"not changed: {problem}")

    def _go_home(self, now: float) -> None:
        """Begin and end the way home as the operator asks, and tell the operator how it ended."""
        asked, supervisor = self._teleop.homing, self._supervisor
        if asked and not self._homing:
            if refusal := supervisor.go_home():
                self._teleop.end_homing(now, f"not homing: {refusal}", arrived=False)
            else:
                self._homing = True
        elif self._homing and not asked:
            self._homing = False
            supervisor.homing.end()
        elif self._homing and not supervisor.homing.active:
            self._homing = False
            self._teleop.end_homing(now, supervisor.homing.outcome or "the way home was ended")
