"""The one loop: input -> teleop -> control -> plant, once per tick. The only module that knows them all."""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from q2r2_control.config import Config
from q2r2_control.control.controller import LONGEST_DT, CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.plants.base import Plant
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary import RunStatistics, RunSummary
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import ArmTarget, Command, CommandMode, Event, HandSample, Reference, RobotState

INPUTS = ("scripted", "headset")
PLANTS = ("mujoco", "kinematic")
DEFAULT_TRAJECTORY = "reach_grasp_handover"
# Braking from the fastest joint takes well under a second; nobody waits longer for a stop.
_LONGEST_STOP = 2.0  # [s]
_REST = 1e-6  # [rad/s]


@dataclass(frozen=True, slots=True)
class Tick:
    """All that one tick did, for whoever listens."""

    t: float  # since the start of the run [s]
    dt: float  # [s]
    samples: list[HandSample]
    targets: dict[str, ArmTarget]
    engaged: dict[str, bool]
    states: dict[str, str]
    reference: Reference
    state: RobotState  # measured before the tick's command
    tools: dict[str, pin.SE3]  # measured tool poses, world frame
    grippers: dict[str, float]  # measured openings
    compute_time: float  # [s]


class Pipeline:
    """Runs a cell. ``listeners`` are called with every :class:`Tick`; they must not take long.

    ``realtime``: the loop follows the clock, and a tick's dt is the time that really passed, so that a late loop moves
    the robot no faster. Otherwise time is simulated, as fast as the machine can, and the run is repeatable.
    """

    def __init__(self, config: Config, robot: Robot, input: Input, plant: Plant) -> None:
        self.config = config
        self.robot = robot
        self.input = input
        self.plant = plant
        self.controller = CartesianController(robot, config.control)
        self.teleop = Teleop(config.teleop, tuple(robot.arms))
        self.listeners: list[Callable[[Tick], None]] = []
        self._stop = threading.Event()

    @classmethod
    def from_config(cls, config: Config, *, input: Input | str = "scripted", plant: Plant | str = "mujoco") -> Pipeline:
        """Build a pipeline with an input (``scripted``, ``headset``) and a plant (``mujoco``, ``kinematic``).

        Either may also be an object of one's own. Raises :class:`ConfigError` for an unknown name.
        """
        robot = Robot.from_config(config)
        return cls(config, robot, _input_of(input, config), _plant_of(plant, robot, config))

    def stop(self) -> None:
        """Bring the arms to rest and end the run; may be called from any thread or a signal handler."""
        self._stop.set()

    def run(self, duration: float | None = None, realtime: bool = True) -> RunSummary:
        """Run for ``duration`` [s], or until :meth:`stop`, Ctrl-C or SIGTERM; the arms are brought to rest first.

        Raises :class:`ConfigError` for a duration that is not positive.
        """
        if duration is not None and not (math.isfinite(duration) and duration > 0.0):
            raise ConfigError(f"duration = {duration!r}: allowed: a positive number of seconds")
        if not realtime:
            # Whether a solution is late depends on the machine; a repeatable run must not.
            settings = self.config.control.model_copy(update={"solve_time_limit": None})
            self.controller = CartesianController(self.robot, settings)
        self._stop.clear()
        self.input.start()
        try:
            with _stop_on_signals(self.stop), _no_garbage_collection():
                return _Run(self, realtime).until(duration)
        finally:
            self.input.close()
            self.plant.close()

    @property
    def stopping(self) -> bool:
        """Whether :meth:`stop` was called."""
        return self._stop.is_set()


class _Run:
    """State of one run: clock, statistics, last connection."""

    def __init__(self, pipeline: Pipeline, realtime: bool) -> None:
        self._pipeline = pipeline
        self._period = 1.0 / pipeline.config.loop_rate_hz
        self._realtime = realtime
        control = pipeline.config.control
        self._statistics = RunStatistics(pipeline.robot, control.acceleration_limit, control.position_margin)
        self._data = pipeline.robot.model.createData()
        self._connected = False
        self._start = self._now = time.monotonic() if realtime else 0.0
        self._wall_start = time.perf_counter()
        pipeline.plant.reset()
        pipeline.controller.reset(pipeline.plant.state().q)

    def until(self, duration: float | None) -> RunSummary:
        """Tick until ``duration`` is over or a stop is asked for, then until the arms are at rest."""
        ends = math.inf if duration is None else duration
        # Half a period of tolerance: counting periods must not add or lose one by rounding.
        while self._now - self._start < ends - 0.5 * self._period and not self._pipeline.stopping:
            self._tick(stopping=False)
        deadline = self._now + _LONGEST_STOP
        moving = True
        while moving and self._now < deadline:
            moving = bool(np.abs(self._tick(stopping=True).v).max() > _REST)
        return self._statistics.summary(time.perf_counter() - self._wall_start)

    def _tick(self, stopping: bool) -> Reference:
        """One line of the way of the data: sample -> target -> reference -> command -> state."""
        pipeline = self._pipeline
        dt = self._wait()
        began = time.perf_counter()
        samples = self._poll()
        state = pipeline.plant.state()
        tools = self._tools(state)
        commanded = {arm: pipeline.controller.tool_pose(arm) for arm in pipeline.robot.arms}
        targets = pipeline.teleop.update(samples, tools, self._now, commanded)
        poses = {arm: None if stopping else target.pose for arm, target in targets.items()}
        reference = pipeline.controller.step(poses, dt)
        grippers = {arm: target.gripper for arm, target in targets.items()}
        pipeline.plant.apply(
            Command(CommandMode.POSITION, reference.q, reference.v, np.zeros_like(reference.q), grippers)
        )
        compute_time = time.perf_counter() - began
        if samples:
            newest = max(max(sample.pose_stamp, sample.inputs_stamp) for sample in samples)
            self._statistics.latency.add((time.monotonic() if self._realtime else self._now) - newest)
        pipeline.plant.advance(dt)
        self._record(dt, samples, targets, reference, state, tools, compute_time)
        return reference

    def _wait(self) -> float:
        """Let the next tick come; returns the time since the last one [s]."""
        if not self._realtime:
            self._now += self._period
            return self._period
        rest = self._now + self._period - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        before, self._now = self._now, time.monotonic()
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
    ) -> None:
        teleop, statistics = self._pipeline.teleop, self._statistics
        engaged = teleop.engaged
        statistics.tick.add(compute_time)
        statistics.add(dt, reference, targets, tools, engaged)
        for event in teleop.take_events():
            statistics.events.append(_since(event, self._start))
        if not self._pipeline.listeners:
            return
        tick = Tick(
            t=self._now - self._start,
            dt=dt,
            samples=samples,
            targets=targets,
            engaged=engaged,
            states={arm: str(value) for arm, value in teleop.states.items()},
            reference=reference,
            state=state,
            tools=tools,
            grippers=self._pipeline.plant.gripper_openings(),
            compute_time=compute_time,
        )
        for listener in self._pipeline.listeners:
            listener(tick)


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
def _no_garbage_collection() -> Iterator[None]:
    """The loop makes no cycles; a collection in mid-motion would cost it several ticks."""
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
        gc.unfreeze()
