"""The operator's side of one run: input, teleop layer, motion home, requests of a program, vibrations and log."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import cycle

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.bindings import Action
from q2r2_control.config.control import LIVE_IMPEDANCE
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.events import CommonReason, Event, Reason, ReasonKind
from q2r2_control.inputs.base import Input, PolicySource, check_samples
from q2r2_control.loop.control_loop import ArmConditions
from q2r2_control.pipeline.newest_pictures import NewestPictures
from q2r2_control.pipeline.requests import ObstacleRequest, Request, change_of, changed
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.gripper_limiter import Grip
from q2r2_control.supervision.supervisor import Phase, Supervisor
from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import ActionChunk, ArmTarget, HandSample, Observation
from q2r2_control.wording import event_line, sentence

# Each arm's conditions, slip and gripper are examined once in this time [s]. Its events are examined at each tick.
_PERIOD = 0.02
_logger = logging.getLogger(__name__)


class OperatorSide:
    """The operator's side of a run.

    In each tick the loop calls :meth:`poll` and :meth:`targets`, and at its end :meth:`take_events` and
    :meth:`feed_back`.
    """

    def __init__(
        self,
        teleop: Teleop,
        source: Input,
        supervisor: Supervisor,
        controller: CartesianController,
        requests: deque[Request],
        pictures: NewestPictures,
        since: Callable[[float], float],
        impedance: ImpedanceController | None = None,
    ) -> None:
        """``since`` is :meth:`LoopClock.since`."""
        self._pictures, self._since = pictures, since
        self._teleop, self._input, self._supervisor = teleop, source, supervisor
        self._policy = source if isinstance(source, PolicySource) else None
        self.chunks: list[ActionChunk] = []  # The chunks of a policy that the last poll has read.
        self._feels = getattr(source, "feels", True)  # False if no device can vibrate.
        self._controller, self._requests, self._impedance = controller, requests, impedance
        self._homing = False  # True while supervision moves the arms home.
        self._in_the_way: frozenset[str] = frozenset()  # Moving obstacles that were reported too close to an arm.
        self.connected = False
        arms = controller.robot.arms
        self._conditions = ArmConditions(controller)
        self._pulses = {arm: HapticPulses(teleop.settings.haptics) for arm in arms}
        self._grips = {arm: Grip(arms[arm].stroke) for arm in arms}
        # Only one arm is examined in a tick, because two arms would make the tick long.
        self._turns, self._wait, self._due = cycle(arms), _PERIOD / len(arms), -np.inf

    def poll(self, now: float) -> list[HandSample]:
        """Return the new samples of the hands. A lost connection stops the arms that follow hands."""
        samples = check_samples(self._input.poll(now))
        self.chunks = [] if self._policy is None else self._policy.chunks()
        was_connected, self.connected = self.connected, self._input.connected
        if was_connected and not self.connected:
            self._teleop.connection_lost(now)
        return samples

    def targets(self, samples: list[HandSample], tools: Mapping[str, pin.SE3], now: float) -> dict[str, ArmTarget]:
        """Return the operator's targets for the arms; see :meth:`Teleop.update`."""
        if self._requests:
            self._fulfil(now)
        commanded = {arm: self._controller.tool_pose(arm) for arm in tools}
        # If the plant has ended its session, the arms wait for the next session. Meanwhile, a press is refused.
        waits = self._supervisor.phase is not Phase.ACTIVE and self._supervisor.fault
        obstacles = dict.fromkeys(tools, waits) if waits else None
        targets = self._teleop.update(samples, tools, now, commanded, obstacles, chunks=self.chunks)
        self._go_home(now)
        return targets

    def take_events(self, start: float) -> list[Event]:
        """Return and log the events of the arms since the previous call, with times since ``start`` [s]."""
        events = [replace(event, t=event.t - start) for event in self._teleop.take_events()]
        for event in events:
            # The recorder has already logged the end of the recording.
            stopped = is_fault(event) and event.kind is not TeleopReason.RECORDING_ENDED
            if stopped or event.kind is TeleopReason.HANDS_CROSSED:
                _logger.warning("%s arm: %s", event.arm, sentence(event.reason))
            elif _logger.isEnabledFor(logging.DEBUG):
                _logger.debug("%s arm: %s -> %s", event.arm, event.source, event_line(event))
        return events

    def feed_back(self, tick: Tick) -> None:
        """Send the vibrations of one tick to the hands, and give a policy the state that it may see."""
        now = tick.now
        if self._policy is not None:
            pictures = self._pictures.at(now)
            self._policy.observe(Observation(now, tick.state, tick.openings, tick.tools, pictures))
        if not self._feels:
            return
        for event in tick.events:
            self._pulses[event.arm].start_pulse(event)
        self._conditions.note(tick.reference.report, now)
        self._due = max(self._due, now - _PERIOD + self._wait)  # Each arm is examined at most once per tick.
        while now >= self._due:
            self._due += self._wait
            self._inspect(next(self._turns), tick)
        for arm, pulses in self._pulses.items():
            if (feedback := pulses.at(now, self._teleop.hand_of(arm))) is not None:
                self._input.send_haptic(feedback)

    def _inspect(self, arm: str, tick: Tick) -> None:
        pulses, target = self._pulses[arm], tick.targets[arm]
        pulses.slip(target.slip, target.slip_angle)
        pulses.notice(self._conditions.look_at(arm, tick.state, tick.now))
        commanded, opening = tick.command.grippers.get(arm), tick.openings.get(arm)
        if commanded is not None and opening is not None:
            pulses.grasps(self._grips[arm].look(commanded, opening, tick.now))

    def _fulfil(self, now: float) -> None:
        # Only requests that have come before this tick are carried out. Later requests wait for the next tick.
        for _ in range(len(self._requests)):
            request = self._requests.popleft()
            if isinstance(request, TeleopSettings):
                request = change_of(self._teleop.settings, request)
            elif isinstance(request, ObstacleRequest):
                request = request.reason(self._since(request.reported))
            self._teleop.record_event(now, request)
            self._do(request, now)

    def _do(self, request: Reason, now: float) -> None:
        """Do what a program asks for. A reported outcome needs no action, because it is already an event."""
        match request.kind:
            case TeleopReason.HOME_REQUESTED:
                self._teleop.home(now)
            case TeleopReason.PAUSE_REQUESTED:
                self._teleop.pause(now, request)
            case TeleopReason.POLICY_REQUESTED:
                self._teleop.give_back(now)
            case TeleopReason.ENGAGE_REQUESTED:
                self._teleop.press_to_engage()
            case TeleopReason.RECORDING_REQUESTED:
                self._teleop.mark(now, Action(request.detail["action"]))
            case TeleopReason.SETTINGS_REQUESTED:
                settings = changed(self._teleop.settings, request.detail["changes"])
                problem = self._teleop.change(settings, now)
                self._record_change(TeleopReason.SETTINGS_CHANGED, problem, now)
                for pulses in self._pulses.values() if problem is None else ():
                    pulses.strength = settings.haptics.strength
            case TeleopReason.CONTROL_REQUESTED:
                values = request.detail["changes"]
                springs = {name: value for name, value in values.items() if name in LIVE_IMPEDANCE}
                if springs and self._impedance is not None:
                    self._impedance.change(springs)
                refused = self._controller.change({k: v for k, v in values.items() if k not in springs})
                problem = None if refused is None else Reason.of(TeleopReason.CONTROL_REFUSED, text=refused)
                self._record_change(TeleopReason.CONTROL_CHANGED, problem, now)

            case TeleopReason.OBSTACLE_REPORTED:
                name, given = request.detail["name"], request.detail["obstacle"]
                pair = self._controller.move_obstacle(name, None if given is None else MovingObstacle(**given))
                if pair is not None and name not in self._in_the_way:
                    reason = Reason.of(TeleopReason.OBSTACLE_IN_THE_WAY, name=name, pair=" | ".join(pair))
                    self._teleop.record_event(now, reason)
                self._in_the_way = self._in_the_way - {name} if pair is None else self._in_the_way | {name}

    def _record_change(self, changed: ReasonKind, problem: Reason | None, now: float) -> None:
        outcome = Reason(changed) if problem is None else Reason(TeleopReason.NOT_CHANGED, cause=problem)
        self._teleop.record_event(now, outcome)

    def _go_home(self, now: float) -> None:
        """Begin and end the motion home as the operator asks, and report how it ended."""
        asked, homing = self._teleop.homing, self._supervisor.homing
        if asked and not self._homing:
            refusal = self._supervisor.go_home()
            if refusal is not None:
                self._teleop.end_homing(now, Reason(TeleopReason.NOT_HOMING, cause=refusal))
            self._homing = refusal is None
        elif self._homing and not asked:
            self._homing = False
            homing.end()
        elif self._homing and not homing.active:
            self._homing = False
            self._teleop.end_homing(now, homing.outcome or Reason(CommonReason.HOMING_ENDED))
