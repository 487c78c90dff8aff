"""``cartesian_controller``: the built-in controller for all arms of a cell. It turns target poses into joint commands.

Targets of the left arm are on ``/q2r2/left/target_frame``; the parameter ``left.target_topic`` names another topic.
Joint states of all arms are on ``joint_states``; ``left.joint_states_topic`` names another topic for the left arm.
Commands are on the topic that the parameter ``output_topic`` names for all arms, or ``left.output_topic`` for the left
arm. Parameters of other arms begin with their names. Moving obstacles are on ``~/obstacles``. With the output ``none``
another controller moves the arms, and follows ``~/safe_target/left``. The module :mod:`supervisor` has the rules for
targets.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from std_srvs.srv import SetBool, Trigger

from q2r2_control.config.cell_file import load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import TorqueDrive, permitted
from q2r2_control.events import Reason
from q2r2_control.loop.control_loop import ControlLoop
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.unchecked import check_watched
from q2r2_control.ros.base_node import ERROR, OK, WARN, ManagedNode
from q2r2_control.ros.bridge.controller_feedback import GRIPPER_DELAY, ControllerFeedback, GripperLimits
from q2r2_control.ros.bridge.intakes import COMMAND_TIME, JointIntake, TargetIntake
from q2r2_control.ros.bridge.joint_outputs import KINDS, NONE, make_output
from q2r2_control.ros.bridge.lbr_driver import LbrDrivers
from q2r2_control.ros.bridge.live_parameters import make_control_live, make_impedance_live, make_watching_live
from q2r2_control.ros.bridge.obstacle_intake import ObstacleIntake
from q2r2_control.ros.executor import TickExecutor
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.joint_watch import (
    ExternalArms,
    ExternalSettings,
    settings_for_external_arms,
    watch_settings,
)
from q2r2_control.supervision.reasons import ROUTINE
from q2r2_control.supervision.standstill import JOINTS, LAGGING_JOINTS, StandstillLimits
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.supervision.target_stream import Origins, StreamSettings
from q2r2_control.supervision.tick_pacer import TickClock
from q2r2_control.types import LONGEST_DT, Reference
from q2r2_control.wording import sentence

_LONGEST_STOP = 3.0  # When the node ends or is deactivated, longest time until the arms rest [s].
_QUIET = 0.3  # The node commands only after other commanders have been silent for this time [s].
_LONGEST_ACTIVATION = 2.0  # Longest time of an activation in addition to the settle time [s].
_SAFE_TARGET_PERIOD = 0.02  # Time between two safe targets if no other controller follows them [s].


class CartesianControllerNode(ManagedNode):
    """Passes the messages of its topics to a :class:`ControlLoop`, and publishes the commands of this loop."""

    ticks = True
    priority = 40  # No other program may delay a joint command. ros2_control runs drivers at the priority 50.

    def __init__(self) -> None:
        super().__init__("cartesian_controller")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        rate = self.parameter("rate", 250.0, "of the control loop [Hz]", within=(20, 1000))
        output = self.parameter("output", "trajectory", "what the arms are commanded with", one_of=(*KINDS, NONE))
        self._is_external = output == NONE  # Whether another controller moves the arms.
        if self._is_external:
            config = settings_for_external_arms(config)
        robot = Robot.from_config(config)
        check_watched(robot, config.name)
        self._period = 1.0 / rate
        self._output = make_output(output, self, robot, config, self._period)
        self._targets = TargetIntake(self, robot, self.report_health)
        feels = config.admittance.enabled and not self._output.drive.yields
        drivers = self._output.driver_namespaces(robot)
        self._joints = JointIntake(self, robot, needs_external_torque=feels, told_by_drivers=bool(drivers))
        self._output.theirs = self._joints.theirs
        self._drivers: LbrDrivers | None = None
        if drivers:
            self._drivers = told = LbrDrivers(self, robot, drivers, self._output.drive.mode, self._joints.take_external)
            self._joints.driver_fault, self._joints.driver_held = told.fault, told.held
            self._output.withheld = told.withheld
        streams, external = StreamSettings(linked=config.teleop.linked), ExternalSettings()
        watch = watch_settings(config.supervision, self._output.drive.yields)
        # Joint states come from another node. If their numbers are not finite, this is a fault at once.
        watch.unusable_time = 0.0
        make_watching_live(self, streams, watch, external)
        self._watch = watch
        if isinstance(self._output.drive, TorqueDrive):
            make_impedance_live(self, self._output.drive.impedance)
        self._controller = CartesianController(
            robot, permitted(config.control.timed(realtime=True), self._output.drive), bridge_held=False
        )
        make_control_live(self, self._controller)
        self._obstacles = ObstacleIntake(self, self._controller)
        self._output.drive.average(self._period)
        self._loop = ControlLoop(
            self._controller,
            self._output.drive,
            self._period,
            streams,
            watch,
            origins=Origins(self._joints.source, self._targets.source, self._takers),
            external=ExternalArms(robot, self._controller, external, streams, watch) if self._is_external else None,
            gripper_delay=GRIPPER_DELAY,
            owns_plant=False,
            standstill=self._standstill(output),
        )
        self._supervisor = self._loop.supervisor
        # If another controller moves the arms, the arms' fingers count as anywhere between closed and open.
        asking = {} if self._is_external else self._targets.topics
        self._grippers = GripperLimits(self, config, self._loop, asking)
        self._clock_of_ticks = TickClock(self._period)
        self._reference: Reference | None = None
        self._commanding, self._advances = False, 0  # ``_advances`` counts the ticks in which time has passed.
        self._requests = 0  # Number of calls of the services that let arms hold, stop or go home.
        # Every safe target is sent if another controller follows them. Nodes that only listen get one at intervals,
        # because they need only the newest one.
        every = 1 if self._is_external else max(round(_SAFE_TARGET_PERIOD * rate), 1)
        self._feedback = ControllerFeedback(self, self._controller, self._targets, every)
        self._last_tick = self.now
        self._deactivated = Reason.of(RosReason.CONTROLLER_DEACTIVATED, controller=self.get_fully_qualified_name())
        self._others = self._output.watch(self)
        self._other: Reason | None = None  # Names another node that commands the arms; None if there is none.
        self._connect()
        self.start_active()
        self.get_logger().info(f"{config.name}: {', '.join(robot.arms)}; waits for joint states")

    def _standstill(self, output: str) -> StandstillLimits | None:
        """Return the limits by which a driver that stands still is found; None if none has to be found.

        A compliant arm may also stand still because a person holds it. Its driver is therefore not judged.
        """
        if output == NONE:
            return LAGGING_JOINTS
        return None if self._output.drive.yields else JOINTS

    def _takers(self, arm: str) -> str:
        return self._output.takers(self, self._controller.robot.arms[arm].joints)

    def _connect(self) -> None:
        self._targets.subscribe(self._supervisor.update_target, self._supervisor.targets.release)
        self._joints.subscribe(self._loop.observe, self._grippers.take_joint_state)
        self.create_service(SetBool, "~/pause", self._on_pause)
        home, hold = self._supervisor.go_home, self._supervisor.homing.hold
        for name, act in (("home", home), ("hold", hold), ("reset", self._supervisor.reset), ("stop", self._stop)):
            self.create_service(Trigger, f"~/{name}", partial(self._serve, act))
        self.create_tick(self._period, self._tick)

    def _tick(self) -> None:
        decided = time.monotonic()
        if self._output.waits():
            return  # Nothing is sent in this tick, and the next tick counts as late.
        now = self._clock_of_ticks.at(self.now)
        # ``dt`` is bounded, so that a late tick causes no jump, and a clock that was set back causes no motion.
        gap = now - self._last_tick
        dt = self._loop.pace(gap)
        if gap > max(LONGEST_DT, self._watch.timeout):  # The node stood still longer than joint states may be missing.
            self._supervisor.stalled(gap, now)
        self._last_tick = now
        self.ticked += 1
        if dt > 0.0:
            self._advance(now, dt, decided)
        self._feedback.tell_followed(self._supervisor.follows)

    def _advance(self, now: float, dt: float, decided: float) -> None:
        self._advances += 1
        if not self._is_external:  # Arms of another controller are judged by their measured posture.
            self._loop.watch_skew(self._joints.timings(now), self._period + COMMAND_TIME, now)
        inactive = self._supervisor.phase is Phase.INACTIVE
        self._other = self._others.intruder() if self._commanding else self._others.commander()
        if inactive and (self._other is not None or self._grippers.awaits(now)):
            return
        if self._other is not None and self._supervisor.phase is Phase.ACTIVE:
            self._supervisor.stop(self._other)
        # A new receiver must not get commands for a posture away from the arms, because the arms would jump.
        if fault := self._output.listener_fault(self._supervisor.off_reference):
            self._supervisor.let_go(fault, now)
        state, openings = self._joints.state, self._grippers.openings(now)
        step = self._loop.step(state, {}, now, dt, self._grippers.wanted, openings)
        self._grippers.answer()
        if step.reference is not None and step.command is not None and state is not None:
            if self._drivers is not None and not self._commanding:
                self._drivers.begin()
            self._output.send(step.command, state, now, decided)
            if self._drivers is not None:
                self._drivers.commanded(step.command.q)
            self._reference = step.reference
            self._feedback.publish(step.reference, state, now, dt, decided)
        elif self._commanding and state is not None:
            self._output.end(state, now)
        self._commanding = step.reference is not None
        if not self._commanding:
            self._others.rest()
        if events := self._supervisor.events:
            log = self.get_logger()
            for event in events:
                if event.root.kind in ROUTINE | {RosReason.NODE_ENDS}:
                    log.info(sentence(event))
                else:
                    log.warning(sentence(event))
            events.clear()
            self.report_health()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._requests += 1
        self._supervisor.pause(request.data)
        self.report_health()  # Nodes that listen to the reports need the new state at once.
        return _answer(response, None)

    def _serve(self, act: Callable[[], Reason | None], request: Any, response: Any) -> Any:
        self._requests += 1
        refusal: Reason | None = self._deactivated
        if self.is_active or act == self._stop:
            other = None if act == self._stop or self._commanding else self._others.commander()
            refusal = other or act()
        self.report_health()
        return _answer(response, refusal)

    def _stop(self) -> Reason | None:
        self._supervisor.stop(Reason(RosReason.STOP_SERVICE))
        return None

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        supervisor, now = self._supervisor, self.now
        fault = supervisor.fault or self._other if self.is_active else self._deactivated
        fault = None if fault is None else self._others.named(fault)
        refused, ended, homed = self._targets.faults(), supervisor.targets.ended, supervisor.homing.outcome
        values: dict[str, Any] = {
            "phase": supervisor.phase,
            "lifecycle": self.lifecycle_state,
            "fault": None if fault is None else fault.as_json(),
            "homing_outcome": None if homed is None else homed.as_json(),
            "ceased_kind": "" if supervisor.ceased is None else str(supervisor.ceased.root.kind),
            "requests": self._requests,
            "loop_rate_hz": self.tick_rate(),
            "missed_ticks": self._loop.pacer.missed_ticks,
            "sent": self._output.sent,
        }
        for arm, rejected in self._targets.rejected.items():
            state = "paused" if supervisor.paused else supervisor.arm_state(arm)
            values[f"{arm}_state"] = state if self.is_active else "deactivated"
            refusal = refused.get(arm)
            values[f"{arm}_target_refusal"] = None if refusal is None else refusal.as_json()
            age = supervisor.targets.age(arm, now)
            values[f"{arm}_target_age_s"] = round(age, 3) if age < 1e6 else "none"
            values[f"{arm}_targets_rejected"] = rejected
            values[f"{arm}_targets_from"] = self._targets.publishers.of(self._targets.topics[arm])
            values[f"{arm}_gripper_held_by"] = self._grippers.held.get(arm, "")
        for arm, holds in self._loop.holding.items():
            values[f"{arm}_holds_object"] = holds
        if self._reference is not None:
            report = self._reference.report
            if (pair := self._controller.narrow_pair) is not None:
                values["nearer_than_min_distance"] = "|".join(pair)
            values["qp_status"] = str(report.status)
            values["closest_pair"] = "|".join(report.closest_pair)
            values["tightest_pair"] = "|".join(report.tightest_pair)
            values["closest_distance_m"] = round(report.closest_distance, 4)
        if fault is not None:
            values["kind"] = str(fault.kind)
            cure = "; ~/reset activates again" if supervisor.phase is Phase.STOPPED and self.is_active else ""
            return ERROR if self.is_active else WARN, sentence(fault) + cure, values
        doing = [f"target of {arm} not used: {sentence(why)}" for arm, why in refused.items()]
        doing = doing or ["paused" if supervisor.paused else "active"]
        return WARN if refused else OK, "; ".join([*doing, *map(sentence, ended.values())]), values

    def begin(self) -> str | None:
        """Begin to command the arms where they stand. Return why this is not possible, or None.

        It is not possible if the arms move or if another node commands them.
        """
        self._tick_until(lambda: False, _QUIET)
        if (other := self._others.commander(_QUIET)) is not None:
            return sentence(other)
        if (refusal := self._supervisor.reset()) is not None:
            return sentence(refusal)
        settle = float(self.get_parameter("settle_time").value)
        active = self._tick_until(lambda: self._supervisor.phase is Phase.ACTIVE, settle + _LONGEST_ACTIVATION)
        problem = None if active else self._supervisor.fault or Reason(RosReason.ARMS_MOVE)
        # This check comes last, because commands begin with the next tick.
        if (problem := self._others.commander(_QUIET) or problem) is not None:
            self._supervisor.let_go(problem, self.now)
            self._supervisor.stop(self._deactivated)
            return sentence(problem)
        self._others.end()
        return None

    def end(self) -> str | None:
        """Bring the arms to rest along the certified stop. After that another node may command them."""
        self._come_to_rest(self._deactivated, self._tick_on)
        self._others.begin()
        return None

    def close(self) -> None:
        """Bring the arms to rest along the certified stop before the commands end."""

        def spin() -> None:
            if self.executor is not None:
                self.executor.spin_once(timeout_sec=self._period)

        self._come_to_rest(Reason(RosReason.NODE_ENDS), spin)

    def _come_to_rest(self, why: Reason, go_on: Callable[[], None]) -> None:
        self._supervisor.stop(why)
        last = time.monotonic()
        deadline = last + _LONGEST_STOP
        advances = self._advances
        try:
            while self._supervisor.phase is Phase.BRAKING and (now := time.monotonic()) < deadline:
                # ``go_on`` takes joint states and runs ticks. If simulated time has ended, ticks no longer brake the
                # arms. The code below then brakes them.
                go_on()
                if self._advances != advances:
                    advances, last = self._advances, now
                elif now - last > 2.0 * self._period:
                    self._advance(self.now, self._period, now)
        finally:
            if self._commanding and self._joints.state is not None:
                self._output.end(self._joints.state, self.now)
            self._commanding = False
            self._others.rest()

    def _tick_on(self) -> None:
        """Run one tick during a call of a service. The executor runs no ticks until the call ends."""
        time.sleep(self._period)
        if isinstance(self.executor, TickExecutor):
            self.executor.take_messages()
        self._tick()

    def _tick_until(self, condition: Callable[[], bool], longest: float) -> bool:
        deadline = time.monotonic() + longest
        while not (fulfilled := condition()) and time.monotonic() < deadline:
            self._tick_on()
        return fulfilled


def _answer(response: Any, refusal: Reason | None) -> Any:
    response.success, response.message = refusal is None, "done" if refusal is None else sentence(refusal)
    return response
