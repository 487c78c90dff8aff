"""One run of the loop: input -> teleop -> control -> plant at every tick, and rest at its end, whatever ended it."""

from __future__ import annotations

import logging
import math
import time
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from q2r2_control.errors import PlantError
from q2r2_control.loop.geometry_updates import GeometryUpdates
from q2r2_control.pipeline.operator_side import OperatorSide
from q2r2_control.pipeline.plant_clock import PlantClock
from q2r2_control.pipeline.run_recorder import RunRecorder
from q2r2_control.summary.tick import RunStart, Tick
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.supervision.tick_pacer import TickPacer
from q2r2_control.teleop.arm import OPEN
from q2r2_control.types import LONGEST_DT, ArmTarget, Command, HandSample, Reference, RobotState

if TYPE_CHECKING:  # which makes the runs
    from q2r2_control.pipeline.pipeline import Pipeline

STOPPING = "stopping"  # state of every arm while the run ends
# Added to the time that full braking takes; an arm that still recovers into its limits is not waited for longer.
_STOP_ALLOWANCE = 1.0  # [s]
_REST = 1e-6  # of the reference [rad/s]

_logger = logging.getLogger(__name__)


class PipelineRun:
    """One run of a :class:`Pipeline`: its clock, its figures, and what lasts from tick to tick."""

    def __init__(self, pipeline: Pipeline, realtime: bool) -> None:
        self._pipeline = pipeline
        self._recorder = RunRecorder(pipeline.robot, pipeline.config.control, pipeline.listeners, pipeline.stop)
        self._data = pipeline.robot.model.createData()
        self._targets = {arm: ArmTarget(None, OPEN) for arm in pipeline.robot.arms}
        self._following = True
        pipeline.plant.reset()
        state = pipeline.plant.state()
        self._clock = pipeline.make_clock(realtime)
        self._start = RunStart(self._clock.now, state)
        control = pipeline.config.control
        limit = pipeline.robot.velocity_limit * control.velocity_scale
        self._acceleration = pipeline.robot.capped_acceleration(control.acceleration_limit)
        self._pacer = TickPacer(1.0 / pipeline.config.loop_rate_hz, limit, self._acceleration, pipeline.drive.coasts)
        self._plant_clock = PlantClock(state)
        self._state = state  # the newest that the plant gave
        self._supervisor = pipeline.supervisor
        self._supervisor.activate(replace(state, stamp=self._clock.now), self._clock.now)
        self._supervisor.events.clear()
        self._bodies = GeometryUpdates(pipeline.controller, pipeline.drive)
        pipeline.drive.reset(state)
        self._bodies.begin()
        self._grippers: dict[str, float] = {arm: target.gripper for arm, target in self._targets.items()}
        self._openings: dict[str, float] = {}  # measured, that the tick went by
        self._velocity = np.zeros(pipeline.robot.model.nv)
        self._operator = OperatorSide(
            pipeline.teleop, pipeline.input, self._supervisor, pipeline.controller, pipeline.requests
        )
        pipeline.teleop.marks.recorded = self._recorder.keeps_episodes

    def until(self, duration: float | None) -> RunSummary:
        """Tick until ``duration`` is over or a stop is asked for, then until the arms are at rest."""
        ends = math.inf if duration is None else duration
        try:
            while not (self._clock.after(ends) or self._pipeline.stopping):
                self.tick()
                self._raise_fault()
        except BaseException:
            # The arms come first, whatever failed. What failed may fail again; the first fault tells more.
            with suppress(Exception):
                self._bring_to_rest()
            raise
        self._bring_to_rest()
        if fault := self._supervisor.state_fault:
            raise PlantError(fault)
        return self._recorder.summary(self._clock, self._pacer)

    def _bring_to_rest(self) -> None:
        """Tick without input and targets until all stands still; no fault of an input can prevent it."""
        self._following = False
        self._targets = {arm: ArmTarget(None, target.gripper) for arm, target in self._targets.items()}
        drive, plant = self._pipeline.drive, self._pipeline.plant
        self._supervisor.stop("the run has ended")
        self._supervisor.events.clear()
        try:
            velocity = np.abs(self.tick().v)
            speed = float(velocity.max())
            deadline = self._clock.now + float((velocity / self._acceleration).max()) + _STOP_ALLOWANCE
            while (speed > _REST or not drive.at_rest(self._state)) and self._clock.now < deadline:
                speed = float(np.abs(self.tick().v).max())
        finally:
            # From the last state that came: a plant that has lost its sensors still takes commands.
            command = drive.last_command(self._state, self._grippers)
            if command is not None:
                plant.apply(command)

    def _raise_fault(self) -> None:
        """End the run where supervision has stopped the arms."""
        if self._supervisor.phase is not Phase.ACTIVE:
            raise PlantError(self._supervisor.fault or "the arms were stopped")

    def tick(self) -> Reference:
        """One line of the way of the data: sample -> target -> reference -> command -> state."""
        pipeline, drive = self._pipeline, self._pipeline.drive
        gap = self._clock.wait()
        dt = self._pacer.step(gap, self._velocity)
        began = time.perf_counter()
        samples = self._operator.poll(self._clock.now) if self._following else []
        state = self._state = pipeline.plant.state()
        tools = self.tools(state)
        self._observe(state)
        if self._following:
            commanded = {arm: pipeline.controller.tool_pose(arm) for arm in pipeline.robot.arms}
            self._targets = self._operator.targets(samples, tools, self._clock.now, commanded)
        self.limit_grippers()
        reference, trusted = self._advance(dt), self._supervisor.state_fault is None
        command = drive.command(reference, state, self._grippers, dt, trusted)
        pipeline.plant.apply(command)
        compute_time = time.perf_counter() - began
        self._recorder.add_latency(samples, self._clock.read())
        # A plant that is simulated lets no more time pass at once, as if the computer had stood still.
        given = min(gap, LONGEST_DT)
        pipeline.plant.advance(given)
        self._plant_clock.give(given)
        self.record(gap, dt, samples, reference, state, tools, command, compute_time)
        return reference

    def _observe(self, state: RobotState) -> None:
        """Let supervision look at what was measured. A stall needs no more than that: nothing else moves this plant."""
        supervisor, now = self._supervisor, self._clock.now
        seen, passed = self._plant_clock.stamped(state, now)
        supervisor.take_joint_state(seen, now, passed)
        if supervisor.events:
            for line in supervisor.events:
                _logger.warning(line)
            supervisor.events.clear()

    def _advance(self, dt: float) -> Reference:
        """The reference of this tick; once the arms were stopped, what is left of their motion."""
        reference = self._supervisor.tick(self._clock.now, dt)
        if reference is None:
            reference = self._pipeline.controller.step({}, dt)
        self._velocity = reference.v
        self._bodies.after_step()
        return reference

    def limit_grippers(self) -> None:
        """What the grippers are commanded to; see :meth:`GeometryUpdates.limit_grippers`."""
        wanted = {arm: target.gripper for arm, target in self._targets.items()}
        self._openings = self._pipeline.plant.gripper_openings()
        self._grippers = self._bodies.limit_grippers(wanted, self._openings, self._clock.now)

    def tools(self, state: RobotState) -> dict[str, pin.SE3]:
        """Measured tool poses, world frame."""
        robot = self._pipeline.robot
        pin.forwardKinematics(robot.model, self._data, state.q)
        return {
            name: pin.updateFramePlacement(robot.model, self._data, arm.frame_id).copy()
            for name, arm in robot.arms.items()
        }

    def record(
        self,
        dt: float,
        step: float,
        samples: list[HandSample],
        reference: Reference,
        state: RobotState,
        tools: dict[str, pin.SE3],
        command: Command,
        compute_time: float,
    ) -> None:
        """Add one tick to the summary and tell the listeners; a tick that nobody listens to is not put together."""
        teleop, report, recorder = self._pipeline.teleop, self._pipeline.drive.report, self._recorder
        engaged = teleop.engaged if self._following else dict.fromkeys(self._targets, False)
        events = self._operator.take_events(self._clock.start)
        recorder.add(
            dt, compute_time, reference, self._targets, tools, engaged, report, events, self._bodies.held_grippers
        )
        recorder.add_holding(dt, self._bodies.holding)
        if self._following:
            now, openings = self._clock.now, self._openings
            feedback = self._operator.feedback
            feedback.update(now, events, self._targets, reference.report, state, self._grippers, openings)
        if not recorder.listened:
            return
        tick = Tick(
            t=self._clock.now - self._clock.start,
            start=self._start,
            now=self._clock.now,
            dt=dt,
            step=step,
            following=self._following,
            connected=self._operator.connected,
            samples=samples,
            targets=self._targets,
            engaged=engaged,
            states={arm: str(value) if self._following else STOPPING for arm, value in teleop.states.items()},
            reference=reference,
            state=state,
            openings=self._openings,
            tools=tools,
            command=command,
            events=events,
            grippers=self._pipeline.plant.gripper_openings(),
            held_grippers=dict(self._bodies.held_grippers),
            holding=self._bodies.holding,
            compute_time=compute_time,
            impedance=report.impedance,
            wall=report.wall,
            admittance=report.admittance,
        )
        recorder.tell(tick)
