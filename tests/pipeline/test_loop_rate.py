"""Loops adapt to the speed of the computer.

Paced simulated time is at most as fast as real time. A loop in real time gets a rate that it can keep.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import repeat

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import AUTO
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline import pipeline as pipeline_module
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.verification.contract import Contract
from tests.pipeline.loops import pipeline

_MEASURED = {"compute_time", "solve_time"}  # These times depend on the computer, so they are not compared.


def flat(value: object) -> object:
    """Return everything in a tick as nested tuples that can be compared to the bit, without times of the computer."""
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, pin.SE3):
        return value.homogeneous.tobytes()
    if isinstance(value, dict):
        return tuple((key, flat(each)) for key, each in value.items())
    if isinstance(value, list | tuple):
        return tuple(map(flat, value))
    if is_dataclass(value):
        return tuple((one.name, flat(getattr(value, one.name))) for one in fields(value) if one.name not in _MEASURED)
    return repr(value)


def ticks_of(duration: float, *, paced: bool, busy_s: float = 0.0) -> list[object]:
    """Return all ticks of a run in torque mode, whose listener keeps the computer busy after each tick."""
    loop = pipeline(ScriptedInput("circle", human=True, seed=3), plant="mujoco", mode="torque")
    seen: list[object] = []

    def keep(tick: Tick) -> None:
        seen.append(flat(tick))
        time.sleep(busy_s)

    loop.listeners.append(keep)
    summary = loop.run(duration, realtime=False, paced=paced)
    assert summary.real_time_factor is not None
    assert not busy_s or summary.real_time_factor < 1.0
    return seen


@pytest.mark.slow
def test_a_paced_run_equals_an_unpaced_run_to_the_bit_also_on_a_slow_computer() -> None:
    fast = ticks_of(0.9, paced=False)
    assert len(fast) >= 450
    assert ticks_of(0.9, paced=True) == fast
    assert ticks_of(0.9, paced=True, busy_s=0.003) == fast


@pytest.mark.parametrize(
    ("tick_s", "rate", "words"),
    [
        (0.0005, 1000.0, "loop rate 1000 Hz: 99 of 100 ticks take at most 500 us, 50 % of the period"),
        (0.0007, 500.0, "loop rate 500 Hz: 99 of 100 ticks take at most 700 us, 35 %"),
        (0.0013, 250.0, "loop rate 250 Hz: 99 of 100 ticks take at most 1300 us, 32 %"),
        (0.0030, 250.0, "loop rate 250 Hz, the lowest: 99 of 100 ticks take at most 3000 us, 75 %"),
    ],
)
def test_the_highest_rate_at_which_the_computer_has_time_left_in_each_tick_is_chosen_and_printed(
    tick_s: float, rate: float, words: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Pipeline, "_resting_ticks", lambda self: repeat(tick_s))
    loop = pipeline(loop_rate_hz=AUTO)
    with caplog.at_level(logging.INFO):
        fit = loop.fit_rate()
    assert fit is not None
    assert (fit.rate_hz, loop.config.loop_rate_hz) == (rate, rate)
    assert words in caplog.text


def test_ticks_that_measure_the_computer_move_no_arm_and_reach_no_listener() -> None:
    loop = pipeline(loop_rate_hz=AUTO)
    heard: list[Tick] = []
    loop.listeners.append(heard.append)
    fit = loop.fit_rate()
    assert fit is not None
    assert loop.config.loop_rate_hz in (1000.0, 500.0, 250.0)
    np.testing.assert_array_equal(loop.plant.state().q, loop.robot.home)
    assert not heard
    assert len(loop.listeners) == 1


def test_no_ticks_are_measured_if_the_cell_has_a_rate_or_if_the_time_is_simulated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(self: Pipeline) -> Iterator[float]:
        raise AssertionError("no ticks are measured")

    monkeypatch.setattr(Pipeline, "_resting_ticks", fail)
    assert pipeline(loop_rate_hz=400.0).fit_rate() is None
    summary = pipeline(loop_rate_hz=AUTO).run(0.1, realtime=False)
    assert summary.ticks == pytest.approx(101, abs=2), "1000 Hz"


def test_a_loop_that_falls_behind_prints_one_line_that_says_what_would_help(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(pipeline_module.LoopClock, "falls_behind", lambda self: True)
    pipeline().run(0.1, realtime=False)
    (line,) = (record.getMessage() for record in caplog.records if "falls behind" in record.getMessage())
    for cure in ("close other programs", "--rt", "or set a lower loop_rate_hz"):
        assert cure in line


def test_if_a_loop_with_a_measured_rate_falls_behind_the_line_says_that_the_rate_was_chosen_at_the_start(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Pipeline, "_resting_ticks", lambda self: iter([1e-5] * 1000))
    monkeypatch.setattr(pipeline_module.LoopClock, "falls_behind", lambda self: True)
    loop = pipeline(loop_rate_hz=AUTO)
    loop.fit_rate()
    loop.run(0.1, realtime=False)
    (line,) = (record.getMessage() for record in caplog.records if "falls behind" in record.getMessage())
    assert "The rate was chosen at the start" in line


def error_in_free_air(rate: float, mode: str) -> float:
    """Return the RMS error of the worse tool on a circle [mm], with the contract checked at every tick."""
    source = ScriptedInput("circle", frequency_hz=0.5)
    loop = pipeline(source, plant="mujoco" if mode == "torque" else "kinematic", mode=mode, loop_rate_hz=rate)
    contract = Contract(loop.controller)

    def look(tick: Tick) -> None:
        if tick.following:
            contract.check(tick.reference, tick.step)

    loop.listeners.append(look)
    summary = loop.run(2.5, realtime=False)
    assert summary.uncertified_ticks == 0
    assert summary.at_rest
    errors = [arm.position_error_mm_rms for arm in summary.arms.values()]
    return max(error for error in errors if error is not None)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["position", "torque"])
def test_tools_follow_at_250_hz_as_well_as_at_1000_hz_and_the_contract_holds(mode: str) -> None:
    assert error_in_free_air(250.0, mode) <= 1.5 * error_in_free_air(1000.0, mode)


@pytest.mark.slow
def test_arms_that_block_each_other_come_to_rest_at_250_hz(robot: Robot) -> None:
    controller = CartesianController(robot, ControllerSettings(acceleration_limit=10.0))
    controller.reset(robot.home)
    contract, dt = Contract(controller), 0.004
    tools = {arm: controller.tool_pose(arm) for arm in robot.arms}
    between = 0.5 * sum(tool.translation for tool in tools.values())
    targets = {arm: pin.SE3(tool.rotation, between) for arm, tool in tools.items()}
    accelerations = []
    for _ in range(1500):
        reference = controller.step(targets, dt)
        contract.check(reference, dt)
        accelerations.append(reference.a)
    assert reference.report.closest_distance < 0.03, "the arms block each other"
    assert np.sqrt(np.square(accelerations[-125:]).mean(axis=0)).max() < 0.1
