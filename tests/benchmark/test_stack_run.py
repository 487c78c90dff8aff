"""Work from hand samples through the whole stack: as safe and as close as with targets alone, and every fault shows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from q2r2_control.benchmark.stack_bench import run_stack_bench
from q2r2_control.benchmark.stack_run import Stack, StackFigures
from q2r2_control.config.cell import load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.types import CommandMode, Reference
from q2r2_control.verification.work_motions import WORK_MOTIONS, carry

pytestmark = pytest.mark.slow

# At 500 Hz, the lowest rate with one substep a tick, since most of a test's time goes by ticks.
CONFIG = load_config("config/dual_iiwa7.yaml").model_copy(update={"loop_rate_hz": 500.0})
BOTH_MODES = pytest.mark.parametrize("mode", ["position", "torque"])
CARRY = replace(carry(0.20, 0.30, shortest=1.0), rest=0.6)
PASS = replace(WORK_MOTIONS["pass"], rest=0.6)
SLIDE = replace(WORK_MOTIONS["slide"], rest=1.5)
# The left tool goes 0.1 m ahead in half a second.
SHORT = replace(
    WORK_MOTIONS["stretch"],
    name="short",
    duration=0.5,
    path=lambda t, home: home + np.array([[0.2 * t, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    rest=0.5,
)


@cache
def stack(mode: str, free: bool = False) -> Stack:
    return Stack(CONFIG, mode, free)


@cache
def carry_in_free_air() -> StackFigures:
    return stack("position", free=True).run(CARRY)


def value(figure: float | None) -> float:
    assert figure is not None
    return figure


def assert_safe(figures: StackFigures) -> None:
    """Every promise at every tick, to the end; measured links at their distances, motors within their torques."""
    assert figures.passed, figures
    assert figures.fallback_percent == 0.0
    assert value(figures.max_acceleration_ratio) <= 1.0 + 1e-9
    assert value(figures.measured_margin_mm) > 0.0
    assert value(figures.max_torque_ratio) < 0.9
    assert figures.slip_mm == 0.0


@BOTH_MODES
def test_arms_that_carry_something_follow_the_hands_as_they_do_in_free_air(mode: str) -> None:
    figures, free = stack(mode).run(CARRY), carry_in_free_air()
    assert_safe(figures)
    assert value(figures.rms_error_mm) <= 1.5 * value(free.rms_error_mm)
    # All but the filter's delay, of which 0.3 m/s makes 13.5 mm.
    assert value(figures.path_error_mm) <= 1.5 * value(free.path_error_mm) < 7.0


@BOTH_MODES
def test_arms_get_past_each_other_where_the_hands_lead_them(mode: str) -> None:
    figures = stack(mode).run(PASS)
    assert_safe(figures)
    assert value(figures.arrival_s) < 2.0
    assert value(figures.end_error_mm) < 3.0


@BOTH_MODES
def test_a_hand_that_presses_down_slides_the_tool_over_the_table_and_rests_there(mode: str) -> None:
    figures = stack(mode).run(SLIDE, seed=None)
    assert_safe(figures)
    assert 10.0 < value(figures.end_error_mm) < 11.0, "10 mm lower than it may"
    assert value(figures.path_error_mm) < 12.0
    assert value(figures.rest_acceleration) < 0.1


def test_in_free_air_a_tool_goes_through_the_table() -> None:
    down = replace(SHORT, path=lambda t, home: home - np.array([[0.0, 0.0, 0.4 * t], [0.0, 0.0, 0.0]]))
    figures = stack("position", free=True).run(down)
    assert value(figures.end_error_mm) < 2.0, "20 mm below the table's top"
    assert (figures.measured_distance_mm, figures.measured_margin_mm) == (None, None)


def test_a_promise_that_is_broken_in_one_tick_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    step, ticks = CartesianController.step, []

    def jumps(controller: CartesianController, *arguments: object) -> Reference:
        reference = step(controller, *arguments)  # type: ignore[arg-type]
        ticks.append(reference)
        return replace(reference, q=reference.q + 1e-3) if len(ticks) == 600 else reference

    monkeypatch.setattr(CartesianController, "step", jumps)
    report = run_stack_bench(CONFIG, [SHORT], [CommandMode.POSITION])
    (row,) = report.rows
    (figures,), (free,) = row.figures, row.free_air
    assert figures.broken["travel in a tick / what v allows"] >= 1
    assert not figures.passed
    assert not report.passed
    assert report.as_json()["passed"] is False
    assert (figures.mode, free.mode, free.measured_pair) == ("position", "position", None)


def test_arms_that_do_not_follow_end_the_run_and_hands_that_jump_pause_them() -> None:
    watch = CONFIG.supervision.model_copy(update={"max_deviation": 1e-5, "deviation_time": 0.01})
    figures = Stack(CONFIG.model_copy(update={"supervision": watch}), "position").run(SHORT)
    assert not figures.passed
    assert figures.stopped is not None
    assert "from its reference" in figures.stopped
    assert figures.done < 1.0
    assert figures.rms_error_mm is None
    gate = CONFIG.teleop.gate.model_copy(update={"max_jump": 0.002})
    teleop = CONFIG.teleop.model_copy(update={"gate": gate})
    figures = Stack(CONFIG.model_copy(update={"teleop": teleop}), "position").run(SHORT)
    assert not figures.passed
    assert figures.pauses[0] == "left: the hand jumped 0.003 m"
