"""Torque mode, and position mode with an admittance, in whole runs in MuJoCo: pushed arms and lost measurements."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, Array, RobotState
from tests.support.hands_input import HandsInput
from tests.support.processes import Watch, assert_torque_bounds, cell

pytestmark = pytest.mark.slow

BLIND = cell().supervision.unusable_time
ENGAGED = 0.3  # After this time, hands that stay where they are have engaged both arms [s].


def configured(**sections: dict[str, object]) -> Config:
    """Return the shipped cell at 500 Hz. ``sections`` has the changed keys of each section of the configuration."""
    changed = {name: getattr(cell(), name).model_copy(update=keys) for name, keys in sections.items()}
    return cell().model_copy(update={"loop_rate_hz": 500.0, **changed})


def at(t: float, action: Callable[[], object]) -> Callable[[Tick], None]:
    """Return a listener that calls ``action`` once, at the first tick from ``t`` [s] on."""
    done: list[Tick] = []

    def listener(tick: Tick) -> None:
        if not done and tick.t >= t:
            done.append(tick)
            action()

    return listener


def pushed(config: Config, mode: str, push: Array, start: float, duration: float) -> tuple[Pipeline, Watch]:
    """Return a pipeline with resting hands, whose left tool is pushed from ``start`` on for ``duration`` [s]."""
    loop = Pipeline.from_config(config, input=HandsInput(), plant="mujoco", mode=mode)
    plant = loop.plant
    assert isinstance(plant, MujocoPlant)
    loop.listeners.append(at(start, lambda: plant.push("left", push, duration)))
    return loop, Watch(loop)


def way(watch: Watch, arm: str) -> Array:
    """Return at each tick (n,) the distance [m] of the arm's measured tool from its position at the time ENGAGED."""
    start = next(tick for tick in watch.ticks if tick.t >= ENGAGED)
    return np.array(
        [np.linalg.norm(tick.tools[arm].translation - start.tools[arm].translation) for tick in watch.ticks]
    )


def test_in_torque_mode_an_arm_that_is_pushed_towards_the_other_arm_never_touches_it_and_returns() -> None:
    # The spring is so soft that the push overcomes it. The wall bears the rest of the push.
    config = configured(impedance={"translational_stiffness": 300.0, "rotational_stiffness": 100.0})
    loop, watch = pushed(config, "torque", np.array([0.0, -100.0, 0.0, 0.0, 0.0, 0.0]), ENGAGED, 1.5)
    summary = loop.run(6.5, realtime=False)
    assert_torque_bounds(loop, watch.ticks)
    for tick in watch.ticks[::20]:
        assert min(pair.distance for pair in loop.robot.distances(tick.state.q)) > 0.005
    walls = [tick.wall for tick in watch.ticks if tick.wall is not None]
    assert min(wall.closest_distance for wall in walls) > 0.005
    assert not walls[-1].pressing
    assert way(watch, "left").max() > 0.1
    assert max(way(watch, arm)[-1] for arm in SIDES) < 2e-3
    torque = summary.torque
    assert torque is not None
    assert torque.pressed_pairs == sorted({pair for wall in walls for pair in wall.pressing})
    assert any({name.split("_")[0] for name in pair} == set(SIDES) for pair in torque.pressed_pairs)
    assert torque.min_measured_distance_mm is not None
    assert 5.0 < torque.min_measured_distance_mm < 1e3 * config.control.min_distance
    assert 20.0 < torque.max_wall_force_n <= config.impedance.wall.maximum_force
    assert torque.off_reference_s["left"] > 1.0
    assert torque.held_ticks == 0
    assert json.loads(json.dumps(summary.as_json(), allow_nan=False))["torque"]["pressed_pairs"]


def test_in_position_mode_with_an_admittance_a_push_moves_the_tool_and_the_tool_returns() -> None:
    config = configured(admittance={"enabled": True})
    loop, watch = pushed(config, "position", np.array([0.0, 30.0, 0.0, 0.0, 0.0, 0.0]), ENGAGED, 1.2)
    summary = loop.run(3.0, realtime=False)
    settled = next(index for index, tick in enumerate(watch.ticks) if tick.t >= 1.4)
    band = 1.0 - (config.admittance.force_dead_band / 30.0) ** 2
    asked = 30.0 * band / config.admittance.stiffness
    tick = watch.ticks[settled]
    assert tick.admittance is not None
    arm = tick.admittance.arms["left"]
    np.testing.assert_allclose(arm.wrench[:3], [0.0, 30.0, 0.0], atol=0.5)
    np.testing.assert_allclose(arm.displacement[:3], [0.0, asked, 0.0], atol=1e-3)
    # The servos yield by some millimetres too.
    assert asked - 1e-3 < way(watch, "left")[settled] < asked + 6e-3
    assert way(watch, "right").max() < 1e-3
    engaged = [index for index, tick in enumerate(watch.ticks) if all(tick.engaged.values())]
    assert way(watch, "left")[engaged[-1]] < 5e-4
    targets = [pose.homogeneous for index in engaged if (pose := watch.ticks[index].targets["left"].pose) is not None]
    np.testing.assert_allclose(targets, np.broadcast_to(targets[0], (len(engaged), 4, 4)), atol=1e-9)
    # The error is relative to the operator's target, so that it includes the displacement.
    errors = way(watch, "left")[engaged]
    figures = summary.arms["left"]
    assert figures.position_error_mm_rms == pytest.approx(1e3 * np.sqrt(np.mean(np.square(errors))), rel=0.05)
    assert figures.yielded_mm_max == pytest.approx(1e3 * asked, abs=1.0)
    assert summary.arms["right"].yielded_mm_max == 0.0
    assert summary.torque is None
    assert summary.fallback_ticks == 0


def test_an_admittance_on_a_plant_that_measures_no_external_torque_is_refused() -> None:
    loop = Pipeline.from_config(configured(admittance={"enabled": True}), input=HandsInput(), plant="kinematic")
    with pytest.raises(ConfigError, match=r"admittance\.enabled = true: allowed with a plant that measures external"):
        loop.run(0.1, realtime=False)


class BlindPlant(MujocoPlant):
    """A simulated cell whose sensors fail. ``broken`` is one joint's wrong value in the array ``what``, or None."""

    broken: float | None = None
    what = "q"

    def state(self) -> RobotState:
        state = super().state()
        if self.broken is None:
            return state
        values = getattr(state, self.what).copy()
        values[3] = self.broken
        return replace(state, **{self.what: values})


def blinded(what: str, value: float, start: float, duration: float) -> tuple[Pipeline, Watch, BlindPlant]:
    """Return a pipeline whose hands swing sideways, and whose measurement fails at ``start`` for ``duration`` [s]."""
    config = configured()
    robot = Robot.from_config(config)
    plant = BlindPlant(robot, config)
    plant.what = what

    def swing(t: float) -> Array:
        return np.array([0.0, 0.0, 0.05 * (1.0 - np.cos(4.0 * max(t - 0.5, 0.0))), 0.0, 0.0, 0.0])

    loop = Pipeline(config, robot, HandsInput(left=swing, right=swing), plant, "torque")
    watch = Watch(loop)
    loop.listeners.append(at(start, lambda: setattr(plant, "broken", value)))
    loop.listeners.append(at(start + duration, lambda: setattr(plant, "broken", None)))
    return loop, watch, plant


@pytest.mark.parametrize(("what", "value"), [("q", np.nan), ("v", np.inf)])
def test_after_a_short_loss_of_measurements_the_run_continues_and_its_summary_counts_the_lost_ticks(
    what: str, value: float
) -> None:
    loop, watch, _ = blinded(what, value, 0.9, 0.8 * BLIND)
    summary = loop.run(1.6, realtime=False)
    assert summary.torque is not None
    assert summary.torque.held_ticks == sum(tick.impedance is not None and tick.impedance.held for tick in watch.ticks)
    assert 15 <= summary.torque.held_ticks <= 25
    assert summary.torque.min_measured_distance_mm is not None
    json.dumps(summary.as_json(), allow_nan=False)
    assert all((np.abs(tick.state.tau) <= loop.robot.torque_limit).all() for tick in watch.ticks)
    last = watch.ticks[-1]
    np.testing.assert_allclose(last.state.q, last.reference.q, atol=5e-3)


@pytest.mark.parametrize(("what", "value", "said"), [("q", np.nan, "position"), ("v", -np.inf, "velocity")])
def test_a_permanent_loss_of_measurements_ends_the_run_and_the_plants_servos_bring_the_arms_to_rest(
    what: str, value: float, said: str
) -> None:
    loop, watch, plant = blinded(what, value, 0.9, 60.0)
    message = f"measured {said} of left_A4 = {value} for more than 50 ms; allowed: finite numbers"
    with pytest.raises(PlantError, match=re.escape(message)):
        loop.run(60.0, realtime=False)
    held = [tick for tick in watch.ticks if tick.impedance is not None and tick.impedance.held]
    assert np.abs(held[0].reference.v).max() > 0.05, "it was moving"
    assert held[0].t > 0.9
    assert watch.ticks[-1].t < 0.9 + BLIND + 1.0
    assert np.abs(watch.ticks[-1].reference.v).max() < 1e-3
    plant.broken = None
    plant.advance(0.2)
    rest = plant.state()
    assert np.abs(rest.v).max() < 1e-2
    np.testing.assert_allclose(rest.q, watch.ticks[-1].reference.q, atol=5e-3)
