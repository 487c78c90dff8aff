"""The operator's side of one run: input, teleop layer, way home, a program's requests, vibrations and log."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import cycle
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.bindings import Action
from q2r2_control.config.control import LIVE_IMPEDANCE
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.inputs.base import Input, PolicySource
from q2r2_control.loop.control_loop import ArmConditions
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.gripper_limiter import Grip
from q2r2_control.supervision.supervisor import Phase, Supervisor
from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import ActionChunk, ArmTarget, HandSample, Observation
from q2r2_control.wording import event_line, sentence

_PERIOD = 0.02  # of looking at more of an arm than its events [s]
_logger = logging.getLogger(__name__)


@dataclass(slots=True)
class PendingRequests:
    """Requests of a program, set from any thread; each is done at the next tick, and recorded for a replay."""

    home: bool = False
    pause: bool = False
    give_back: bool = False
    engage: bool = False
    mark: Action | None = None  # of the recording
    settings: TeleopSettings | None = None
    control: Mapping[str, float] | None = None  # of the controller and the impedance, by name
    of_recording: list[Reason] = field(default_factory=list)  # verdicts on episodes, and why it ended

    def __bool__(self) -> bool:
        asked = self.home or self.pause or self.give_back or self.engage or self.settings is not None
        return asked or self.control is not None or self.mark is not None or bool(self.of_recording)

    def clear(self) -> None:
        """Ask for nothing any more."""
        self.home, self.pause, self.give_back, self.engage = False, False, False, False
        self.mark, self.settings, self.control = None, None, None
        self.of_recording.clear()

    def reasons(self, current: TeleopSettings) -> Iterator[Reason]:
        """One for each request; settings by what is not as it is in the ``current`` ones."""
        if self.home:
            yield Reason(ReasonKind.HOME_REQUESTED)
        if self.pause:
            yield Reason(ReasonKind.PAUSE_REQUESTED)
        if self.give_back:
            yield Reason(ReasonKind.POLICY_REQUESTED)
        if self.engage:
            yield Reason(ReasonKind.ENGAGE_REQUESTED)
        if self.mark is not None:
            yield Reason.of(ReasonKind.RECORDING_REQUESTED, action=str(self.mark))
        if self.settings is not None:
            changed = _difference(current.model_dump(mode="json"), self.settings.model_dump(mode="json"))
            yield Reason.of(ReasonKind.SETTINGS_REQUESTED, changes=changed)
        if self.control is not None:
            yield Reason.of(ReasonKind.CONTROL_REQUESTED, changes=dict(self.control))
        yield from self.of_recording

    def repeat(self, reason: Reason, current: TeleopSettings) -> None:
        """Request what a recorded ``reason`` says was requested. Raises ValueError for settings that are none."""
        if reason.kind is ReasonKind.HOME_REQUESTED:
            self.home = True
        elif reason.kind is ReasonKind.PAUSE_REQUESTED:
            self.pause = True
        elif reason.kind is ReasonKind.POLICY_REQUESTED:
            self.give_back = True
        elif reason.kind is ReasonKind.ENGAGE_REQUESTED:
            self.engage = True
        elif reason.kind is ReasonKind.RECORDING_REQUESTED:
            self.mark = Action(reason.detail["action"])
        elif reason.kind is ReasonKind.CONTROL_REQUESTED:
            self.control = reason.detail["changes"]
        elif reason.kind is ReasonKind.SETTINGS_REQUESTED:
            changed = _merged(current.model_dump(mode="json"), reason.detail["changes"])
            self.settings = TeleopSettings.model_validate(changed)
        elif reason.kind is ReasonKind.VERDICT and reason not in self.of_recording:
            self.of_recording.append(reason)


def _difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in new.items():
        before = old.get(name)
        if value == before:
            continue
        same = isinstance(value, dict) and isinstance(before, dict) and value.keys() == before.keys()
        found[name] = _difference(before, value) if same and isinstance(before, dict) else value
    return found


def _merged(old: Mapping[str, Any], changed: Mapping[str, Any]) -> dict[str, Any]:
    inner = {
        name: _merged(old[name], value)
        if isinstance(value, dict) and isinstance(old.get(name), dict) and value.keys() <= old[name].keys()
        else value
        for name, value in changed.items()
    }
    return {**old, **inner}


class OperatorSide:
    """Once a tick: :meth:`poll`, :meth:`targets`, and at its end :meth:`take_events` and :meth:`feed_back`."""

    def __init__(
        self,
        teleop: Teleop,
        source: Input,
        supervisor: Supervisor,
        controller: CartesianController,
        requests: PendingRequests,
        impedance: ImpedanceController | None = None,
    ) -> None:
        self._teleop, self._input, self._supervisor = teleop, source, supervisor
        self._policy = source if isinstance(source, PolicySource) else None
        self.chunks: list[ActionChunk] = []  # of a policy, since the last poll
        self._controller, self._requests, self._impedance = controller, requests, impedance
        self._homing = False  # supervision is on the way home
        self.connected = False
        arms = controller.robot.arms
        self._conditions = ArmConditions(controller)
        self._pulses = {arm: HapticPulses(teleop.settings.haptics) for arm in arms}
        self._grips = {arm: Grip(arms[arm].stroke) for arm in arms}
        # One arm after the other: both in one tick would make that tick a long one.
        self._turns, self._wait, self._due = cycle(arms), _PERIOD / len(arms), -np.inf

    def poll(self, now: float) -> list[HandSample]:
        """Samples of the hands; a connection that is lost stops the arms that hands drive."""
        samples = self._input.poll(now)
        self.chunks = [] if self._policy is None else self._policy.chunks()
        was_connected, self.connected = self.connected, self._input.connected
        if was_connected and not self.connected:
            self._teleop.connection_lost(now)
        return samples

    def targets(self, samples: list[HandSample], tools: Mapping[str, pin.SE3], now: float) -> dict[str, ArmTarget]:
        """The operator's targets for the arms; see :meth:`Teleop.update`."""
        if self._requests:
            self._fulfil(now)
        commanded = {arm: self._controller.tool_pose(arm) for arm in tools}
        # Arms whose plant ended its session wait for the next one, and a press is refused meanwhile.
        waits = self._supervisor.phase is not Phase.ACTIVE and self._supervisor.fault
        obstacles = dict.fromkeys(tools, waits) if waits else None
        targets = self._teleop.update(samples, tools, now, commanded, obstacles, chunks=self.chunks)
        self._go_home(now)
        return targets

    def take_events(self, start: float) -> list[Event]:
        """Events of the arms since the last call, by the time since ``start`` [s]; they are logged."""
        events = [replace(event, t=event.t - start) for event in self._teleop.take_events()]
        for event in events:
            if is_fault(event) and event.kind is not ReasonKind.RECORDING_ENDED:  # which the recorder has logged
                _logger.warning("%s arm: %s", event.arm, sentence(event.reason))
            elif _logger.isEnabledFor(logging.DEBUG):
                _logger.debug("%s arm: %s -> %s", event.arm, event.source, event_line(event))
        return events

    def feed_back(self, tick: Tick) -> None:
        """Send the vibrations of one tick to the hands, and what a policy may see of it."""
        now = tick.now
        if self._policy is not None:
            self._policy.observe(Observation(now, tick.state, tick.openings, tick.tools))
        for event in tick.events:
            self._pulses[event.arm].start_pulse(event)
        self._conditions.note(tick.reference.report, now)
        self._due = max(self._due, now - _PERIOD + self._wait)  # each arm once at most
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
        requests = replace(self._requests)
        for reason in self._requests.reasons(self._teleop.settings):
            self._teleop.record_event(now, reason)
        self._requests.clear()
        if requests.home:
            self._teleop.home(now)
        if requests.pause:
            self._teleop.pause(now, Reason(ReasonKind.PAUSE_REQUESTED))
        if requests.give_back:
            self._teleop.give_back(now)
        if requests.engage:
            self._teleop.press_to_engage()
        if requests.mark is not None:
            self._teleop.mark(now, requests.mark)
        if (settings := requests.settings) is not None:
            problem = self._teleop.change(settings, now)
            self._record_change(ReasonKind.SETTINGS_CHANGED, problem, now)
            for pulses in self._pulses.values() if problem is None else ():
                pulses.strength = settings.haptics.strength
        if requests.control is not None:
            springs = {name: value for name, value in requests.control.items() if name in LIVE_IMPEDANCE}
            if springs and self._impedance is not None:
                self._impedance.change(springs)
            refused = self._controller.change({k: v for k, v in requests.control.items() if k not in springs})
            problem = None if refused is None else Reason.of(ReasonKind.CONTROL_REFUSED, text=refused)
            self._record_change(ReasonKind.CONTROL_CHANGED, problem, now)

    def _record_change(self, changed: ReasonKind, problem: Reason | None, now: float) -> None:
        outcome = Reason(changed) if problem is None else Reason(ReasonKind.NOT_CHANGED, cause=problem)
        self._teleop.record_event(now, outcome)

    def _go_home(self, now: float) -> None:
        """Begin and end the way home as the operator asks, and tell the operator how it ended."""
        asked, homing = self._teleop.homing, self._supervisor.homing
        if asked and not self._homing:
            refusal = self._supervisor.go_home()
            if refusal is not None:
                self._teleop.end_homing(now, Reason(ReasonKind.NOT_HOMING, cause=refusal))
            self._homing = refusal is None
        elif self._homing and not asked:
            self._homing = False
            homing.end()
        elif self._homing and not homing.active:
            self._homing = False
            self._teleop.end_homing(now, homing.outcome or Reason(ReasonKind.HOMING_ENDED))
