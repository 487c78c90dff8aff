"""The one loop: input -> teleop -> control -> plant, once per tick. The only module that knows them all."""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from q2r2_control.config import Config
from q2r2_control.control.controller import LONGEST_DT, CartesianController
from q2r2_control.control.impedance import ImpedanceController, ImpedanceReport
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.plants.base import Plant
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary import RunStatistics, RunSummary
from q2r2_control.teleop.arm import OPEN
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import ArmTarget, Array, Command, CommandMode, Event, HandSample, Reference, RobotState

INPUTS = ("scripted", "headset")
PLANTS = ("mujoco", "kinematic")
DEFAULT_TRAJECTORY = "reach_grasp_handover"
STOPPING = "stopping"  # state of every arm while the run ends
# Added to the time that full braking takes; an arm that still recovers into its limits is not waited for longer.
_STOP_ALLOWANCE = 1.0  # [s]
_REST = 1e-6  # of the reference [rad/s]
_STILL = 1e-2  # of an arm on its spring [rad/s]


@dataclass(frozen=True, slots=True)
class Tick:
    """All that one tick did, for whoever listens."""

    t: float  # since the start of the run [s]
    dt: float  # [s]
    samples: list[HandSample]
    targets: dict[str, ArmTarget]
    engaged: dict[str, bool]
    states: dict[str, str]  # of the teleop layer, or STOPPING
    reference: Reference
    state: RobotState  # measured before the tick's command
    tools: dict[str, pin.SE3]  # measured tool poses, world frame
    grippers: dict[str, float]  # measured openings
    compute_time: float  # [s]
    impedance: ImpedanceReport | None = None  # of torque mode


class Pipeline:
    """Runs a cell. ``listeners`` are called with every :class:`Tick`; they must not take long.

    Whatever ends a run, the arms are brought to rest before input and plant are closed. A listener that raises is not
    called again; it ends the run like :meth:`stop`, and then its exception goes to the caller.

    ``realtime``: the loop follows the clock, and a tick's dt is the time that really passed, so that a late loop moves
    the robot no faster. Otherwise time is simulated, as fast as the machine can, and the run is repeatable.
    """

    def __init__(
        self,
        config: Config,
        robot: Robot,
        input: Input,
        plant: Plant,
        mode: CommandMode | str = CommandMode.POSITION,
    ) -> None:
        self.config = config
        self.robot = robot
        self.input = input
        self.plant = plant
        self.mode = _mode_of(mode, plant)
        self.controller = CartesianController(robot, config.control)
        self.impedance = ImpedanceController(robot, config.impedance) if self.mode is CommandMode.TORQUE else None
        self.teleop = Teleop(config.teleop, tuple(robot.arms))
        self.listeners: list[Callable[[Tick], None]] = []
        # A plain flag: unlike the locks of threading.Event, a signal handler can set it in the middle of anything.
        self._stopping = False

    @classmethod
    def from_config(
        cls,
        config: Config,
        *,
        input: Input | str = "scripted",
        plant: Plant | str = "mujoco",
        mode: CommandMode | str = CommandMode.POSITION,
    ) -> Pipeline:
        """Build a pipeline with an input (``scripted``, ``headset``) and a plant (``mujoco``, ``kinematic``).

        Either may also be an object of one's own. ``mode``: the plant gets joint positions (``position``), or joint
        torques of a Cartesian impedance (``torque``). Raises :class:`ConfigError` for an unknown name, and for a mode
        that the plant does not have.
        """
        robot = Robot.from_config(config)
        return cls(config, robot, _input_of(input, config), _plant_of(plant, robot, config), mode)

    def stop(self) -> None:
        """Bring the arms to rest and end the run, or the next one if none runs; from any thread or signal handler."""
        self._stopping = True

    def run(self, duration: float | None = None, realtime: bool = True) -> RunSummary:
        """Run for ``duration`` [s], or until :meth:`stop`, Ctrl-C or SIGTERM; the arms are brought to rest first.

        Raises :class:`ConfigError` for a duration that is not positive.
        """
        if duration is not None and not (math.isfinite(duration) and duration > 0.0):
            raise ConfigError(f"duration = {duration!r}: allowed: a positive number of seconds")
        self._prepare(realtime)
        try:
            self.input.start()
            with _stop_on_signals(self.stop), _few_garbage_collections():
                return _Run(self, realtime).until(duration)
        finally:
            self._stopping = False
            try:
                self.input.close()
            finally:
                self.plant.close()

    def _prepare(self, realtime: bool) -> None:
        """Nothing of an earlier run may move an arm: every run starts paused and with open grippers, as the plant."""
        self.teleop = Teleop(self.config.teleop, tuple(self.robot.arms))
        settings = self.config.control
        if not realtime:
            # Whether a solution is late depends on the machine; a repeatable run must not.
            settings = settings.model_copy(update={"solve_time_limit": None})
        if settings != self.controller.settings:
            self.controller = CartesianController(self.robot, settings)

    @property
    def stopping(self) -> bool:
        """Whether :meth:`stop` was called, until the run has ended."""
        return self._stopping


class _Run:
    """State of one run: clock, statistics, last connection."""

    def __init__(self, pipeline: Pipeline, realtime: bool) -> None:
        self._pipeline = pipeline
        self._period = 1.0 / pipeline.config.loop_rate_hz
        self._realtime = realtime
        self._statistics = RunStatistics(pipeline.robot, pipeline.config.control)
        self._data = pipeline.robot.model.createData()
        self._listeners = list(pipeline.listeners)
        self._failure: Exception | None = None  # of a listener
        self._targets = {arm: ArmTarget(None, OPEN) for arm in pipeline.robot.arms}
        self._following = True
        self._connected = False
        pipeline.plant.reset()
        state = pipeline.plant.state()
        pipeline.controller.reset(state.q)
        if pipeline.impedance is not None:
            pipeline.impedance.reset(state)
        self._ticks = 0
        self._start = self._now = self._due = time.monotonic() if realtime else 0.0
        self._wall_start = time.perf_counter()

    def until(self, duration: float | None) -> RunSummary:
        """Tick until ``duration`` is over or a stop is asked for, then until the arms are at rest."""
        ends = math.inf if duration is None else duration
        try:
            # Half a period of tolerance: counting periods must not add or lose one by rounding.
            while self._now - self._start < ends - 0.5 * self._period and not self._pipeline.stopping:
                self._tick()
        except BaseException:
            # The arms come first, whatever failed. What failed may fail again; the first fault tells more.
            with suppress(Exception):
                self._bring_to_rest()
            raise
        self._bring_to_rest()
        if self._failure is not None:
            raise self._failure
        return self._statistics.summary(time.perf_counter() - self._wall_start)

    def _bring_to_rest(self) -> None:
        """Tick without input and targets until all stands still; no fault of an input can prevent it."""
        self._following = False
        self._targets = {arm: ArmTarget(None, target.gripper) for arm, target in self._targets.items()}
        try:
            speed = float(np.abs(self._tick().v).max())
            deadline = self._now + speed / self._pipeline.config.control.acceleration_limit + _STOP_ALLOWANCE
            while (speed > _REST or self._swings()) and self._now < deadline:
                speed = float(np.abs(self._tick().v).max())
        finally:
            self._let_go()

    def _swings(self) -> bool:
        """Whether an arm still moves on its spring, in torque mode."""
        pipeline = self._pipeline
        return pipeline.impedance is not None and float(np.abs(pipeline.plant.state().v).max()) > _STILL

    def _let_go(self) -> None:
        """Leave the arms to the plant's position servos where they are: a torque that nobody renews holds nothing."""
        pipeline = self._pipeline
        if pipeline.impedance is None:
            return
        q = pipeline.plant.state().q
        zero = np.zeros_like(q)
        grippers = {arm: target.gripper for arm, target in self._targets.items()}
        pipeline.plant.apply(Command(CommandMode.POSITION, q, zero, zero, grippers))

    def _tick(self) -> Reference:
        """One line of the way of the data: sample -> target -> reference -> (torque) -> command -> state."""
        pipeline = self._pipeline
        dt = self._wait()
        began = time.perf_counter()
        samples = self._poll() if self._following else []
        state = pipeline.plant.state()
        tools = self._tools(state)
        if self._following:
            commanded = {arm: pipeline.controller.tool_pose(arm) for arm in pipeline.robot.arms}
            self._targets = pipeline.teleop.update(samples, tools, self._now, commanded)
        targets = self._targets
        reference = pipeline.controller.step({arm: target.pose for arm, target in targets.items()}, dt)
        tau, impedance = self._torque(reference, state, dt)
        grippers = {arm: target.gripper for arm, target in targets.items()}
        pipeline.plant.apply(Command(pipeline.mode, reference.q, reference.v, tau, grippers))
        compute_time = time.perf_counter() - began
        if samples:
            newest = max(max(sample.pose_stamp, sample.inputs_stamp) for sample in samples)
            self._statistics.latency.add((time.monotonic() if self._realtime else self._now) - newest)
        pipeline.plant.advance(dt)
        self._record(dt, samples, targets, reference, state, tools, compute_time, impedance)
        return reference

    def _torque(self, reference: Reference, state: RobotState, dt: float) -> tuple[Array, ImpedanceReport | None]:
        """Torque of this tick (nv,) [Nm] in torque mode, else zeros."""
        if self._pipeline.impedance is None:
            return np.zeros_like(reference.q), None
        command = self._pipeline.impedance.step(reference, state, dt)
        return command.tau, command.report

    def _wait(self) -> float:
        """Let the next tick come; returns the time since the last one [s]."""
        self._ticks += 1
        if not self._realtime:
            self._now = self._ticks * self._period
            return self._period
        self._due += self._period
        rest = self._due - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        before, self._now = self._now, time.monotonic()
        # Late wake-ups do not add up, since ticks are due on a grid; ticks that were missed are not made up for.
        self._due = max(self._due, self._now - self._period)
        return min(max(self._now - before, 1e-6), LONGEST_DT)

    def _poll(self) -> list[HandSample]:
        source, was_connected = self._pipeline.input, self._connected
        samples = source.poll(self._now)
        self._connected = source.connected
        if was_connected and not self._connected:
            self._pipeline.teleop.connection_lost(self._now)
        return samples

    def _tools(self, state: RobotState) -> dict[str, pin.SE3]:
        robot = self._pipeline.robot
        pin.forwardKinematics(robot.model, self._data, state.q)
        return {
            name: pin.updateFramePlacement(robot.model, self._data, arm.frame_id).copy()
            for name, arm in robot.arms.items()
        }

    def _record(
        self,
        dt: float,
        samples: list[HandSample],
        targets: dict[str, ArmTarget],
        reference: Reference,
        state: RobotState,
        tools: dict[str, pin.SE3],
        compute_time: float,
        impedance: ImpedanceReport | None,
    ) -> None:
        teleop, statistics = self._pipeline.teleop, self._statistics
        engaged = {arm: self._following and value for arm, value in teleop.engaged.items()}
        statistics.tick.add(compute_time)
        statistics.add(dt, reference, targets, tools, engaged)
        for event in teleop.take_events():
            statistics.events.append(_since(event, self._start))
        if not self._listeners:
            return
        tick = Tick(
            t=self._now - self._start,
            dt=dt,
            samples=samples,
            targets=targets,
            engaged=engaged,
            states={arm: str(value) if self._following else STOPPING for arm, value in teleop.states.items()},
            reference=reference,
            state=state,
            tools=tools,
            grippers=self._pipeline.plant.gripper_openings(),
            compute_time=compute_time,
            impedance=impedance,
        )
        self._tell(tick)

    def _tell(self, tick: Tick) -> None:
        """Call every listener; the first exception is kept until the arms are at rest."""
        for listener in list(self._listeners):
            try:
                listener(tick)
            except Exception as error:
                self._listeners.remove(listener)
                self._failure = self._failure or error
                self._pipeline.stop()


def _since(event: Event, start: float) -> Event:
    return replace(event, t=event.t - start)


def _input_of(source: Input | str, config: Config) -> Input:
    if source == "scripted":
        return ScriptedInput(DEFAULT_TRAJECTORY)
    if source == "headset":
        return HeadsetServer(config.headset.host, config.headset.port)
    if isinstance(source, str):
        raise ConfigError(f"input {source!r}: allowed are {', '.join(INPUTS)}")
    return source


def _plant_of(plant: Plant | str, robot: Robot, config: Config) -> Plant:
    if plant == "mujoco":
        return MujocoPlant(robot, config)
    if plant == "kinematic":
        return KinematicPlant(robot, config)
    if isinstance(plant, str):
        raise ConfigError(f"plant {plant!r}: allowed are {', '.join(PLANTS)}")
    return plant


def _mode_of(mode: CommandMode | str, plant: Plant) -> CommandMode:
    if mode not in plant.modes:
        allowed = ", ".join(plant.modes)
        raise ConfigError(f"mode {mode!s:.40}: {type(plant).__name__} follows {allowed} commands only")
    return CommandMode(mode)


@contextmanager
def _stop_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM ask for a stop instead of tearing the loop apart in mid-motion; only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda *_: stop()) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, previous, strict=True):
            signal.signal(number, handler)


@contextmanager
def _few_garbage_collections() -> Iterator[None]:
    """Take all that exists out of garbage collection, which would otherwise cost the loop several ticks each time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
