"""Helpers that many tests use: for processes and the shipped cell, and a listener that checks the contract."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.events import Event
from q2r2_control.inputs.base import Input
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import Plant, make_plant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.verification.contract import Contract
from tests.support.reasons import kinds

_PATIENCE = 120.0  # Timeout far above any usual duration [s].


def children(pid: int) -> list[int]:
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        return [int(child) for child in file.read().split()]


def alive(pid: int) -> bool:
    """Return whether the process runs. A process that has ended may remain as a zombie."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition: Callable[[], object]) -> None:
    """Wait until ``condition`` holds."""
    deadline = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(2e-3)


CELL = "config/dual_iiwa7.yaml"


@cache
def cell() -> Config:
    """Return the shipped cell of two iiwa 7."""
    return load_config(CELL)


@cache
def cell_robot() -> Robot:
    """Return the robot of :func:`cell`. No test changes this robot."""
    return Robot.from_config(cell())


# Blocks of a cell on which its robot does not depend.
_OTHER_BLOCKS = {
    *("loop_rate_hz", "control", "impedance", "admittance", "teleop", "supervision", "headset", "mujoco"),
    *("cameras", "recording", "judge"),
}


def pipeline_of(changes: Mapping[str, object], source: Input, plant: Plant | str, mode: str) -> Pipeline:
    """Return a pipeline for the shipped cell. ``changes`` maps keys of the cell to new blocks.

    If no change concerns the robot, the pipeline uses the shared robot of :func:`cell_robot`.
    """
    config = cell().model_copy(update=dict(changes))
    if not changes.keys() <= _OTHER_BLOCKS:
        return Pipeline.from_config(config, input=source, plant=plant, mode=mode)
    robot = cell_robot()
    return Pipeline(config, robot, source, make_plant(plant, robot, config), mode)


class Watch:
    """A listener that stores every tick, and fails the run at the first tick that violates the contract."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.ticks: list[Tick] = []
        self._pipeline = pipeline
        self._contract: Contract | None = None
        self._openings = pipeline.controller.openings
        pipeline.listeners.append(self)

    def __call__(self, tick: Tick) -> None:
        if self._contract is None:
            self._contract = Contract(self._pipeline.controller, self._pipeline.robot.home)
        if (openings := self._pipeline.controller.openings) != self._openings:
            self._openings = openings
            self._contract.set_openings(openings, before_step=False)
        self._contract.check(tick.reference, tick.step)
        self.ticks.append(tick)

    def engagements(self, arm: str) -> list[int]:
        """Return the indices of the ticks in which ``arm`` became engaged."""
        engaged = [tick.engaged[arm] for tick in self.ticks]
        return [i for i, now in enumerate(engaged) if now and not (i and engaged[i - 1])]


def assert_torque_bounds(pipeline: Pipeline, ticks: list[Tick]) -> None:
    """Assert that torques and their changes between ticks are within their limits at every tick."""
    settings = pipeline.config.impedance
    tau = np.array([tick.state.tau for tick in ticks])
    dt = np.array([tick.dt for tick in ticks])
    assert (np.abs(tau) <= settings.torque_scale * pipeline.robot.torque_limit).all()
    assert (np.abs(np.diff(tau, axis=0)) <= settings.torque_rate_limit * dt[:-1, None] + 1e-6).all()
    assert not any(tick.impedance is None or tick.impedance.held for tick in ticks)


def speed(tick: Tick) -> float:
    """Return the speed of the fastest joint of the reference [rad/s]."""
    return float(np.abs(tick.reference.v).max())


def changes(events: list[Event], arm: str) -> list[tuple[str, str, str]]:
    """Return the state changes of ``arm``, each as (old state, new state, kinds of the reason)."""
    return [(str(event.source), str(event.destination), kinds(event.reason)) for event in events if event.arm == arm]
