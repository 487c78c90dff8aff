"""A loop stands still for a while, or a plant does not obey its commands: the arms stay safe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest

from q2r2_control.errors import PlantError
from q2r2_control.pipeline import loop_clock
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import Plant
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array, RobotState
from tests.pipeline.loops import RecordingPlant
from tests.support.hands_input import HandsInput
from tests.support.processes import Watch, cell, speed

pytestmark = pytest.mark.slow

RATE = 250.0  # [Hz]


def swing(t: float) -> Array:
    """Return the displacement at ``t`` [s] of a hand that swings about as fast as the arms can follow."""
    return np.array([0.0, 0.12 * np.sin(6.0 * max(t - 0.5, 0.0)), 0.0, 0.0, 0.0, 0.0])


def reach(t: float) -> Array:
    """Return the displacement at ``t`` [s] of a hand that moves far and slowly."""
    return np.array([0.0, 0.0, 0.2 * (1.0 - np.cos(1.5 * max(t - 0.5, 0.0))), 0.0, 0.0, 0.0])


def swinging(plant: Plant | str, mode: str = "position", path: Callable[[float], Array] = swing) -> Pipeline:
    config = cell().model_copy(update={"loop_rate_hz": RATE})
    return Pipeline.from_config(config, input=HandsInput(left=path, right=path), plant=plant, mode=mode)


def largest_step(plant: RecordingPlant, limit: Array) -> float:
    """Return the largest step of any joint between two commands, divided by what its limit allows in one period."""
    ways = np.abs(np.diff(np.array([command.q for command in plant.commands]), axis=0))
    return float((ways / (limit / RATE)).max())


class StallingClock:
    """A replacement for the module ``time``: every 0.37 s, the computer stands still for ``stall`` [s]."""

    def __init__(self, stall: float, first: float = 0.9) -> None:
        self._now, self._stall, self._next = 0.0, stall, first

    def monotonic(self) -> float:
        return self._now

    def perf_counter(self) -> float:
        return self._now

    def sleep(self, duration: float) -> None:
        self._now += duration
        if self._now >= self._next:
            self._next += 0.37
            self._now += self._stall


@pytest.mark.parametrize("stall", [0.05, 0.7])
def test_after_a_stall_no_joint_moves_farther_between_two_commands_than_its_limit_allows_in_a_period(
    stall: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_clock, "time", StallingClock(stall))
    plant = RecordingPlant()
    loop = swinging(plant)
    watch = Watch(loop)
    summary = loop.run(4.0)
    assert summary.missed_ticks >= 5
    assert max(tick.dt for tick in watch.ticks) == pytest.approx(stall + 1.0 / RATE, abs=1.0 / RATE)
    assert max(map(speed, watch.ticks)) > 0.5
    assert largest_step(plant, loop.robot.velocity_limit) <= 1.0 + 1e-9
    paused = [event for event in summary.events if event.destination == "lost"]
    assert bool(paused) == (stall > loop.config.teleop.gate.timeout), "a long stall pauses, a short one does not"
    expected = ("loop_stalled", "pose_silent", "pose_gap", "inputs_silent")  # An arm must not pause for other reasons.
    assert all(event.reason.root.kind in expected for event in paused)


def test_a_stall_before_the_first_tick_does_not_count_as_a_fault_of_the_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_clock, "time", StallingClock(0.3, first=0.0))
    loop = swinging(RecordingPlant())
    watch = Watch(loop)
    assert loop.run(1.0).at_rest
    assert watch.ticks[0].dt > 0.3


@pytest.mark.parametrize("mode", ["position", "velocity", "torque"])
def test_a_plant_that_catches_up_after_a_stall_is_not_reported_as_jumping(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_clock, "time", StallingClock(0.09))
    loop = swinging("mujoco", mode)
    watch = Watch(loop)
    summary = loop.run(3.0)
    assert summary.missed_ticks >= 5
    assert max(map(speed, watch.ticks)) > 0.5
    # Commanded velocities act during a whole stall, torques only for 5 ms. Afterwards the arms return to the reference.
    deviation = [np.abs(after.state.q - tick.reference.q).max() for tick, after in pairwise(watch.ticks)]
    assert max(deviation) < {"position": 0.15, "velocity": 0.3, "torque": 0.05}[mode]
    assert summary.at_rest
    assert deviation[-1] < 0.02


@pytest.mark.parametrize(("mode", "plant"), [("velocity", "kinematic"), ("torque", "mujoco")])
def test_if_states_are_lost_while_the_arms_brake_the_old_states_are_no_longer_used(mode: str, plant: str) -> None:
    loop = swinging(plant, mode)
    watch = Watch(loop)
    measure = loop.plant.state
    loop.plant.apply = Mock(wraps=loop.plant.apply)  # type: ignore[method-assign]

    def lose_and_stop(tick: Tick) -> None:
        # Slower motion is braked within 0.1 s, which is as long as states may be missing.
        if speed(tick) > (0.8 if mode == "torque" else 1.1) and tick.following:
            last = measure()
            loop.plant.state = lambda: last  # type: ignore[method-assign]
            loop.stop()

    loop.listeners.append(lose_and_stop)
    with pytest.raises(PlantError, match="no joint states for"):
        loop.run(30.0, realtime=False)
    assert np.abs(loop.plant.apply.call_args.args[0].v).max() < 1e-6
    for _ in range(5):
        loop.plant.advance(0.1)
    rest = measure()
    assert np.abs(rest.v).max() < 1e-2
    assert np.abs(rest.q - watch.ticks[-1].reference.q).max() < 0.05


def test_if_a_plant_sends_no_more_states_its_last_command_stops_the_arms() -> None:
    plant = RecordingPlant()
    loop = swinging(plant, "velocity")

    def fail(state: RobotState) -> RobotState:
        raise RuntimeError("the connection is lost")

    def lose(tick: Tick) -> None:
        if speed(tick) > 0.8:
            plant.disturb = fail

    loop.listeners.append(lose)
    with pytest.raises(RuntimeError, match="the connection is lost"):
        loop.run(30.0, realtime=False)
    assert np.abs(plant.commands[-2].v).max() > 0.5
    assert not plant.commands[-1].v.any()


def blocked(plant: RecordingPlant) -> Callable[[RobotState], RobotState]:
    """Return a disturbance: from now on, the arms stay where they are, and their states say so."""
    q = plant.state().q
    return lambda state: replace(state, q=q, v=np.zeros_like(q))


def frozen(plant: RecordingPlant) -> Callable[[RobotState], RobotState]:
    """Return a disturbance: from now on, the last state is repeated."""
    last = plant.state()
    return lambda state: last


def shifted(by: float) -> Callable[[RecordingPlant], Callable[[RobotState], RobotState]]:
    """Return a function that makes a disturbance: from now on, one joint is measured ``by`` [rad] away."""
    way = np.zeros(14)
    way[3] = by
    return lambda plant: lambda state: replace(state, q=state.q + way)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (blocked, r"(left|right)_A\d is 0\.\d+ rad from its reference for 0\.5 s; allowed: 0\.15 rad for 0\.5 s"),
        (shifted(0.4), r"left_A4 jumped by 0\.(39|40)\d rad"),
        (frozen, r"no joint states for 0\.10\d s; allowed: 0\.1"),
        (shifted(np.nan), r"measured position of left_A4 = nan for more than 50 ms; allowed: finite numbers"),
    ],
    ids=["blocked", "teleporting", "frozen", "not a number"],
)
def test_if_a_plant_does_not_obey_the_arms_brake_and_the_run_ends_with_an_error(
    fault: Callable[[RecordingPlant], Callable[[RobotState], RobotState]], message: str
) -> None:
    plant = RecordingPlant()
    loop = swinging(plant, path=reach)
    watch = Watch(loop)
    broken: list[float] = []

    def break_it(tick: Tick) -> None:
        if not broken and speed(tick) > 0.2:
            broken.append(tick.t)
            plant.disturb = fault(plant)

    loop.listeners.append(break_it)
    with pytest.raises(PlantError, match=message):
        loop.run(30.0, realtime=False)
    assert watch.ticks[-1].t < broken[0] + 2.0
    assert speed(watch.ticks[-1]) <= 1e-6
    assert largest_step(plant, loop.robot.velocity_limit) <= 1.0 + 1e-9
