"""Loops in simulated time, and events in the middle of their motion."""

from __future__ import annotations

from collections.abc import Callable

from q2r2_control.inputs.base import Input
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.loop_clock import LoopClock
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Command, RobotState
from tests.support.processes import cell, cell_robot, pipeline_of, speed


def pipeline(
    source: Input | None = None, plant: str = "kinematic", mode: str = "position", **changes: object
) -> Pipeline:
    """Return a pipeline at 500 Hz, the lowest rate with one substep per tick. Fewer ticks make the tests faster."""
    source = source or ScriptedInput("circle", frequency_hz=0.5)
    return pipeline_of({"loop_rate_hz": 500.0, **changes}, source, plant, mode)


class RecordingPlant(KinematicPlant):
    """A plant that keeps every command and counts calls of close. ``disturb`` changes the states that it measures."""

    def __init__(self) -> None:
        super().__init__(cell_robot(), cell())
        self.closed = 0
        self.commands: list[Command] = []
        self.disturb: Callable[[RobotState], RobotState] = lambda state: state

    def apply(self, command: Command) -> None:
        super().apply(command)
        self.commands.append(command)

    def state(self) -> RobotState:
        return self.disturb(super().state())

    def close(self) -> None:
        self.closed += 1


def when_moving(action: Callable[[], object]) -> Callable[[Tick], None]:
    """Return a listener that calls ``action`` once, in the middle of a motion."""
    acted: list[Tick] = []

    def listener(tick: Tick) -> None:
        if not acted and speed(tick) > 0.1:
            acted.append(tick)
            action()

    return listener


class FreezingClock(LoopClock):
    """A clock of simulated time, in which the loop stands still before a tick if ``freeze`` is greater than 0."""

    freeze = 0.0  # Duration of the standstill before the next tick [s].

    def wait(self) -> float:
        gap, self.freeze = self.period + self.freeze, 0.0
        self.now += gap
        return gap


class FreezingLoop(Pipeline):
    def make_clock(self, realtime: bool) -> LoopClock:
        return FreezingClock(1.0 / self.config.nominal_rate_hz, realtime)

    def freeze(self, duration: float) -> None:
        assert isinstance(self._clock, FreezingClock)
        self._clock.freeze = duration
