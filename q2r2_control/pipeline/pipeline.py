"""Run a cell in one process: input -> teleop -> control -> plant at every tick. At the end, the arms come to rest."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import AUTO, Config
from q2r2_control.control.constraints import Constraint
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import Solver
from q2r2_control.control.tasks.external import Task
from q2r2_control.drives.base import make_drive, permitted
from q2r2_control.errors import ConfigError, PlantError, check_kind, shown
from q2r2_control.events import Reason
from q2r2_control.inputs.base import Input, PolicySource, make_input
from q2r2_control.loop.control_loop import ControlLoop, LoopStep
from q2r2_control.pipeline.loop_clock import LoopClock, PlantClock, WallPace
from q2r2_control.pipeline.loop_rate import FITTING_RATES_HZ, RateFit, largest_usual_time
from q2r2_control.pipeline.newest_pictures import NewestPictures
from q2r2_control.pipeline.operator_side import OperatorSide
from q2r2_control.pipeline.requests import RequestedRun
from q2r2_control.pipeline.run_recorder import RunRecorder
from q2r2_control.pipeline.target_lead import TargetLead
from q2r2_control.plants.base import (
    FaultReportingPlant,
    Plant,
    SessionPlant,
    check_mode,
    check_state,
    keeps_jerk_limit,
    make_plant,
)
from q2r2_control.process.scheduling import few_garbage_collections, stop_on_signals
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turns import TurnCounter
from q2r2_control.robot.unchecked import check_watched
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import RunStart, Tick
from q2r2_control.supervision.joint_watch import watch_settings
from q2r2_control.supervision.preflight import preflight_faults
from q2r2_control.supervision.reasons import ROUTINE, SupervisionReason
from q2r2_control.supervision.supervisor import Phase, Supervisor
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.teleop.arm import OPEN
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import LONGEST_DT, ArmTarget, Array, CommandMode, RobotState, is_number
from q2r2_control.wording import sentence

if TYPE_CHECKING:
    from q2r2_control.cameras.camera_streams import CameraStreams

STOPPING = "stopping"  # The state of every arm while the run ends.
_STOP_ALLOWANCE_S = 1.0  # Further time, after full braking, for an arm that still has to return into its limits.
_REST = 1e-6  # The reference is at rest if no joint is faster than this [rad/s].
_ROUNDING_S = 1e-9
# Longest time for which a simulated plant executes one torque, unless a period is longer. If a late tick let it execute
# a torque for 0.1 s, the torque would drive the arms into each other.
_MAX_TORQUE_HOLD_S = 0.005
_LATE_LOOP = "the loop falls behind: of its %.0f ticks a second more than a tenth come late; %s"
_CURES = "close other programs, give it priority with --rt, or set a lower loop_rate_hz in the cell"
_CURES_OF_FITTED_RATE = (
    "close other programs, or give it priority with --rt. The rate was chosen at the start, when the computer had time "
    "for it, and stays while arms may move: a new run measures again, and loop_rate_hz in the cell sets another"
)
_CURES_AT_LOWEST_RATE = "close other programs, or give it priority with --rt"
_logger = logging.getLogger(__name__)


class Pipeline(RequestedRun):
    """Runs a cell.

    Whatever ends a run, the arms are brought to rest before input and plant are closed. The objects in ``listeners``
    are called with every :class:`Tick` and must not take long. A listener that raises ends the run like :meth:`stop`,
    and the caller gets its exception. A plant whose states are implausible, or which does not follow, ends the run with
    a :class:`PlantError`: see ``supervision``.

    Args:
        config: The cell.
        robot: Its arms.
        input: The device whose hands move the arms, or a policy.
        plant: The real or simulated arms that get the commands.
        mode: Kind of the plant's commands: joint positions, velocities, or the torques of a Cartesian impedance.
        solver: See :class:`CartesianController`, also for ``tasks`` and ``constraints``. A recording does not contain
            these objects, so a replay of the run does not use them.
        tasks: Further costs, in addition to ``config.control.tasks``.
        constraints: Further rows, in addition to the controller's own rows.

    Raises:
        ConfigError: If an argument has another type, if the plant lacks the mode, if the input lacks a control that is
            bound, or if the controller refuses its solver, tasks or constraints.
    """

    def __init__(
        self,
        config: Config,
        robot: Robot,
        input: Input,
        plant: Plant,
        mode: CommandMode | str = CommandMode.POSITION,
        *,
        solver: Solver | str | None = None,
        tasks: Sequence[Task] = (),
        constraints: Sequence[Constraint] = (),
    ) -> None:
        super().__init__()
        check_kind("config", config, Config, "a Config, as load_config returns")
        check_kind("robot", robot, Robot, "a Robot, as Robot.from_config returns")
        check_kind("input", input, Input, "an object with all methods of Input")
        check_kind("plant", plant, Plant, "an object with all methods of Plant")
        config.teleop.bindings.check_device(input.controls)
        self.config, self.robot, self.input, self.plant = config, robot, input, plant
        # Whether position commands can replace torques that are not safe. In a session they cannot, because a session
        # has only one mode.
        has_servos = CommandMode.POSITION in plant.modes and not isinstance(plant, SessionPlant)
        self.drive = make_drive(check_mode(mode, plant), robot, config, has_servos)
        if config.control.jerk_limit is not None and not keeps_jerk_limit(plant, self.drive.mode):
            raise ConfigError(f"control.jerk_limit: allowed: null, since {type(plant).__name__} does not keep it")
        if isinstance(solver, str):
            self.config = config.model_copy(update={"control": config.control.with_solver(solver)})
            solver = None
        self._own: dict[str, Any] = {"solver": solver, "tasks": tasks, "constraints": constraints, "bridge_held": False}
        self.controller = CartesianController(robot, permitted(self.config.control, self.drive), **self._own)
        self._data = robot.model.createData()
        self.listeners: list[Callable[[Tick], None]] = []
        self.cameras: CameraStreams | None = None  # The open real cameras, whose pictures a policy gets.
        # This is a plain flag, because a signal handler cannot take the lock of a threading.Event safely.
        self._stopping = False
        self._ticked = time.monotonic()  # End of the last tick, or a time before the first tick [s].
        self._rate_was_fitted = False  # Whether :meth:`fit_rate` chose the rate of the loop.
        self._pace: WallPace | None = None  # Slows simulated time to the clock's speed; None if it may be faster.
        self._set_up()

    @classmethod
    def from_config(
        cls,
        config: Config,
        *,
        input: Input | str | None = None,
        plant: Plant | str | None = None,
        mode: CommandMode | str = CommandMode.POSITION,
        solver: Solver | str | None = None,
        tasks: Sequence[Task] = (),
        constraints: Sequence[Constraint] = (),
    ) -> Pipeline:
        """Build a pipeline for a cell.

        The other arguments are the same as for the class. A task or constraint may have been made with another Robot of
        the same ``config``.

        Args:
            config: The cell.
            input: The name of an entry point such as ``headset``, see :mod:`q2r2_control.plugins`, or an object; None
                for the input that the cell names.
            plant: The same for the plant, such as ``kinematic``.

        Raises:
            ConfigError: If a name is not known, if the plant lacks the mode, or if the input lacks a control that is
                bound.
            RobotError: If a link is not watched, and the cell does not name it in ``unchecked_links``.
        """
        robot = Robot.from_config(config)
        check_watched(robot, config.name)
        source = make_input(config.input if input is None else input, config)
        moves = make_plant(config.plant if plant is None else plant, robot, config)
        return cls(config, robot, source, moves, mode, solver=solver, tasks=tasks, constraints=constraints)

    @property
    def supervisor(self) -> Supervisor:
        return self.loop.supervisor

    def preflight_faults(self) -> tuple[str, ...]:
        """Return one line for each reason why a run should not start at home; empty if it may.

        ``q2r2 run`` makes the same check. The controller is reset to the home posture. See :func:`preflight_faults` of
        ``supervision``.
        """
        return preflight_faults(self.robot, self.config.control.without_contact(), self.controller)

    def stop(self) -> None:
        """Bring the arms to rest and end the run. If there is no run now, end the next run when it begins.

        Any thread and any signal handler may call this method.
        """
        self._stopping = True

    def run(self, duration: float | None = None, realtime: bool = True, *, paced: bool = False) -> RunSummary:
        """Run until the duration is over, or until :meth:`stop`, Ctrl-C or SIGTERM. At the end, the arms come to rest.

        Args:
            duration: Length of the run [s]; None if only a stop ends it.
            realtime: True if the ticks follow the computer's clock. A late tick then moves no joint farther than the
                velocity limits allow in one period. False if time is simulated, which makes the run repeatable.
            paced: True if simulated time must not pass faster than the computer's clock. On a slow computer it passes
                more slowly. The result is the same as without ``paced``, bit for bit.

        Raises:
            ConfigError: If the duration is not positive, or if the plant does not support this kind of time.
        """
        if duration is not None and not (is_number(duration) and duration > 0.0):
            raise ConfigError(f"duration = {shown(duration)}: allowed: a positive number of seconds")
        if isinstance(self.plant, SessionPlant) and self.plant.realtime_only and not realtime:
            raise ConfigError("simulated time: allowed with a plant that is simulated only")
        try:
            if realtime:
                self.fit_rate()
            self._pace = WallPace() if paced and not realtime else None
            self._prepare(realtime)
            self._start_input(realtime)
            with stop_on_signals(self.stop), few_garbage_collections():
                self._begin(realtime)
                return self._run_until(math.inf if duration is None else duration)
        finally:
            self._stopping = False
            self.end()

    def begin(self) -> None:
        """Begin a run in simulated time whose ticks the caller takes, by :meth:`tick`, :meth:`check` and :meth:`end`.

        Raises:
            ConfigError: If the plant is real, because nothing would bring its arms to rest.
        """
        if isinstance(self.plant, SessionPlant):
            raise ConfigError("ticks one by one: allowed with a plant that is simulated only")
        self._pace = None
        try:
            self._prepare(realtime=False)
            self._start_input(realtime=False)
            self._begin(realtime=False, counts=False)
        except BaseException:  # The caller has no run that it could end.
            self.end()
            raise

    def tick_until(self, end: float) -> None:
        """Take the ticks of a run that has begun, up to the last one at or before ``end`` [s] of the loop's clock.

        Raises:
            PlantError: If supervision has stopped the arms.
            ConfigError: If ``end`` is not a time, or no run has begun.
        """
        if not is_number(end):
            raise ConfigError(f"end = {shown(end)}: allowed: a time [s]")
        if not hasattr(self, "_clock"):
            raise ConfigError("Pipeline.tick_until: call begin() first")
        while self._clock.now <= end - self._clock.period + _ROUNDING_S:
            self.tick()
            self.check()

    def check(self) -> None:
        """Raise :class:`PlantError` if supervision has stopped the arms."""
        phase = self.supervisor.phase
        if phase is Phase.STOPPED or (phase is not Phase.ACTIVE and self._reporting is None):
            fault = self.supervisor.fault
            raise PlantError("the arms were stopped" if fault is None else sentence(fault))

    def end(self) -> None:
        """Close input and plant. It may be called twice, and before a run."""
        self.requests.clear()
        try:
            self.input.close()
        finally:
            self.plant.close()

    def _start_input(self, realtime: bool) -> None:
        if isinstance(self.input, PolicySource):
            self.input.prepare(self.robot, realtime)
        self.input.start()

    def make_clock(self, realtime: bool) -> LoopClock:
        """Make the clock of a run that begins now. A replay overrides this method."""
        return LoopClock(1.0 / self.config.nominal_rate_hz, realtime, self._pace)

    def fit_rate(self) -> RateFit | None:
        """Choose the rate of a loop in real time, if the cell has ``loop_rate_hz: auto``.

        Ticks are taken in real time while the arms rest at the plant's start, first at the highest rate. The rate that
        fits this computer replaces ``auto`` in :attr:`config`. Returns None if the cell names a rate, which is then
        used, or if the plant has sessions, whose cabinets or controllers set the time.
        """
        if self.config.loop_rate_hz != AUTO or isinstance(self.plant, SessionPlant):
            return None
        # The listeners do not get these ticks, which are not part of the run.
        listeners, self.listeners = self.listeners, []
        try:
            for rate in FITTING_RATES_HZ:
                self.config = self.config.model_copy(update={"loop_rate_hz": rate})
                fit = RateFit(rate, largest_usual_time(self._resting_ticks()))
                if fit.leaves_room:
                    break
        finally:
            self.listeners = listeners
        self._rate_was_fitted = True
        _logger.info(str(fit))
        return fit

    def _resting_ticks(self) -> Iterator[float]:
        """Take ticks in real time while the arms rest, and yield the duration of each tick without its wait [s]."""
        self._pace = None
        self._prepare(realtime=True)
        self._begin(realtime=True)
        self._following = False
        while True:
            self.tick()
            yield time.perf_counter() - self._clock.woke

    def _prepare(self, realtime: bool) -> None:
        """Forget the last run, so that none of its data moves an arm. Every run starts paused, with open grippers."""
        settings = permitted(self.config.control.timed(realtime), self.drive)
        if settings != self.controller.settings:
            reports = self.controller.obstacle_reports
            self.controller = CartesianController(self.robot, settings, **self._own)
            for name, (obstacle, age) in reports.items():
                self.controller.move_obstacle(name, obstacle.model_copy(update={"age": age}))
        self._set_up()

    def _set_up(self) -> None:
        self.teleop = Teleop(self.config.teleop, tuple(self.robot.arms))
        watch = watch_settings(self.config.supervision, self.drive.yields)
        streams = StreamSettings(linked=self.config.teleop.linked)
        period, delay = 1.0 / self.config.nominal_rate_hz, self.config.gripper_delay
        if not isinstance(self.plant, SessionPlant):
            self.drive.average(period)
        # A plant has this attribute if another process moves its arms.
        standstill = getattr(self.plant, "standstill", None)
        self.loop = ControlLoop(
            self.controller, self.drive, period, streams, watch, gripper_delay=delay, standstill=standstill
        )

    def _begin(self, realtime: bool, counts: bool = True) -> None:
        self._following = True
        self._told_late = False
        self._targets = {arm: ArmTarget(None, OPEN) for arm in self.robot.arms}
        self._grippers = dict.fromkeys(self.robot.arms, OPEN)  # The commanded openings.
        sessions = self._sessions = self.plant if isinstance(self.plant, SessionPlant) else None
        if sessions is not None:
            sessions.begin(self.drive.mode, lambda: self._stopping)
        self.plant.reset()
        self._state = check_state(self.plant.state(), self.robot)  # The newest measured state.
        self._clock = self.make_clock(realtime)
        self._turns = TurnCounter(self.robot)
        self._turns.counted(self._state.q, self._clock.now)
        self.controller.pass_time(self._clock.since(self._ticked))
        # The reports of obstacles are aged up to the time at which the first tick is due. If that tick is late, it ages
        # them further.
        self.loop.age_obstacles(self._clock.now + self._clock.period)
        self._start = RunStart(self._clock.now, self._state)
        self._plant_clock = PlantClock(self._state)
        self._lead = TargetLead()
        self._watch_skew(self._clock.now)
        reporting = self._reporting = self.plant if isinstance(self.plant, FaultReportingPlant) else None
        if reporting is None or reporting.fault() is None:
            self.loop.activate(self._state, self._clock.now)
            self.supervisor.events.clear()
        else:
            self.loop.wait(self._state)
        is_torque = self.drive.mode is CommandMode.TORQUE
        self._longest_advance = max(_MAX_TORQUE_HOLD_S, self._clock.period) if is_torque else LONGEST_DT
        self._recorder = RunRecorder(self.robot, self.config.control, self.listeners, self.stop, counts)
        shots = None if self.cameras is None else self.cameras.newest_shots(realtime)
        pictures = NewestPictures(self.config, self.plant, shots)
        self._operator = OperatorSide(
            self.teleop,
            self.input,
            self.supervisor,
            self.controller,
            self.requests,
            pictures,
            self._clock.since,
            self.impedance,
        )
        self.teleop.marks.recorded = self._recorder.keeps_episodes
        self.teleop.marks.subtasks = self.config.recording.subtasks

    def _run_until(self, duration: float) -> RunSummary:
        """Tick until ``duration`` [s] is over or a stop is requested, and then until the arms are at rest."""
        try:
            while not (self._clock.after(duration) or self._stopping):
                self.tick()
                self.check()
        except BaseException:
            # The arms come to rest first, whatever has failed. A part that fails again must not hide its first error,
            # which is more helpful.
            with suppress(Exception):
                self._bring_to_rest()
            raise
        self._bring_to_rest()
        if self._reporting is None and (fault := self.supervisor.state_fault):
            raise PlantError(sentence(fault))
        return self._recorder.finish(self._clock, self.loop.pacer)

    def _bring_to_rest(self) -> None:
        """Tick without input and targets until all arms stand still. No fault of an input can prevent it."""
        self._following = False
        self._targets = {arm: ArmTarget(None, target.gripper) for arm, target in self._targets.items()}
        self.supervisor.stop(Reason(SupervisionReason.RUN_ENDED))
        self.supervisor.events.clear()
        try:
            velocity = np.abs(self.tick().reference.v)
            deadline = self._clock.now + float((velocity / self.loop.acceleration_limit).max()) + _STOP_ALLOWANCE_S
            while (velocity.max() > _REST or not self.drive.at_rest(self._state)) and self._clock.now < deadline:
                velocity = np.abs(self.tick().reference.v)
        finally:
            # The last received state is used, because a plant that has lost its sensors still takes commands.
            if (command := self.drive.last_command(self._state, self._grippers)) is not None:
                self.plant.apply(command)

    def tick(self) -> Tick:
        """Pass the data through all stations once: sample -> target -> reference -> command -> state."""
        gap = self._clock.wait()
        now = self._clock.now
        if self._clock.falls_behind() and not self._told_late:
            self._told_late = True
            rate = 1.0 / self._clock.period
            cures = _CURES_OF_FITTED_RATE if self._rate_was_fitted else _CURES
            _logger.warning(_LATE_LOOP, rate, cures if rate > min(FITTING_RATES_HZ) else _CURES_AT_LOWEST_RATE)
        braked, dt = (0.0, self.loop.pace(gap)) if self._sessions is None else self._sessions.due(now)
        began = time.perf_counter()
        samples = self._operator.poll(now) if self._following else []
        given = self.plant.state()
        seen, passed = self._plant_clock.stamped(given, now)
        seen = self._turns.of_state(seen)
        state = self._state = replace(seen, stamp=given.stamp)
        lost = None if self._reporting is None else self._reporting.fault()
        self.loop.observe(seen, now, passed, lost)
        self._watch_skew(now)
        openings, tools = self.plant.gripper_openings(), self._measured_tools(state)
        self.loop.age_obstacles(now)  # This is done before new reports come, because their ages count from now.
        if self._following:
            self._targets = self._operator.targets(samples, tools, now)
        step = self._control(state, openings, now, gap, dt, braked)
        assert step.reference is not None  # In a pipeline, every tick has a reference and a command.
        assert step.command is not None
        self.plant.apply(step.command)
        withdrawn = self._sessions is not None and self._sessions.withdraws()
        if withdrawn:
            self.controller.withdraw(step.reference)
        compute_time = time.perf_counter() - began
        self._recorder.add_latency(samples, self._clock.read())
        # In one tick, the time of a simulated plant advances by at most ``_longest_advance``. If more time has passed
        # since the last tick, the plant skips the rest.
        advance = min(gap, self._longest_advance)
        self.plant.advance(advance)
        self._plant_clock.give(advance)
        tick = Tick(
            t=now - self._clock.start,
            start=self._start,
            now=now,
            dt=gap,
            step=braked + (0.0 if withdrawn else dt),
            following=self._following,
            connected=self._operator.connected,
            samples=samples,
            targets=self._targets,
            chunks=self._operator.chunks if self._following else [],
            engaged=self.teleop.engaged if self._following else dict.fromkeys(self._targets, False),
            interventions=self.teleop.interventions if self._following else dict.fromkeys(self._targets, False),
            states={arm: str(value) if self._following else STOPPING for arm, value in self.teleop.states.items()},
            reference=step.reference,
            state=state,
            openings=openings,
            tools=tools,
            command=step.command,
            events=self._operator.take_events(self._clock.start),
            grippers=self.plant.gripper_openings(),
            held_grippers=dict(self.loop.held_grippers),
            holding=self.loop.holding,
            obstacles=self.controller.obstacle_reports,
            compute_time=compute_time,
            impedance=step.report.impedance,
            wall=step.report.wall,
            admittance=step.report.admittance,
            sessions={} if self._sessions is None else self._sessions.sessions(),
        )
        if self._following:
            self._operator.feed_back(tick)
        self._recorder.add(tick)
        self._ticked = time.monotonic()
        return tick

    def _watch_skew(self, now: float) -> None:
        if self._sessions is not None:
            self.loop.watch_skew(self._sessions.timings(), self._sessions.lead(), now)

    def _measured_tools(self, state: RobotState) -> dict[str, pin.SE3]:
        model, data, arms = self.robot.model, self._data, self.robot.arms
        pin.forwardKinematics(model, data, state.q)
        return {name: pin.updateFramePlacement(model, data, arm.frame_id).copy() for name, arm in arms.items()}

    def _posture(self) -> Array | None:
        """Return the joint positions that a policy asks for (nv,) [rad], or None.

        An arm for which the policy asks for no positions gets its home posture.
        """
        asked = {arm: posture for arm, target in self._targets.items() if (posture := target.posture) is not None}
        if not asked:
            return None
        q = self.robot.home.copy()
        for arm, posture in asked.items():
            q[self.robot.arms[arm].joints] = posture[self.robot.arms[arm].joints]
        return q

    def _control(
        self, state: RobotState, openings: Mapping[str, float], now: float, gap: float, dt: float, braked: float
    ) -> LoopStep:
        """Compute the command from measurements and targets. The operator's targets do not count while a run ends."""
        poses = {arm: target.command for arm, target in self._targets.items()} if self._following else {}
        if self._sessions is not None:
            poses = self._lead.ahead(poses, gap, self._sessions.delay())
        grippers = {arm: target.gripper for arm, target in self._targets.items()}
        step = self.loop.step(state, poses, now, dt, grippers, openings, braked, self._posture())
        self._grippers = step.grippers
        for refusal in step.refusals.values():
            # Without this pause, the operator would think that the arm follows. Operator and recording get the fault
            # that stopped the arms, and not only the phase of the controller to which the fault has led.
            ceased = self.supervisor.ceased if refusal.kind is SupervisionReason.CONTROLLER_PHASE else None
            self.teleop.pause(now, refusal if ceased is None else ceased.root)
        for reason in self.supervisor.events:
            _logger.log(logging.INFO if reason.root.kind in ROUTINE else logging.WARNING, sentence(reason))
        self.supervisor.events.clear()
        return step
