"""A run refuses hostile values from a program with a ConfigError, or keeps the contract at every tick."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.verification.contract import Contract
from tests.pipeline.loops import pipeline
from tests.support.hostile_values import HOSTILE

DT = 0.002  # [s]
CALLS: dict[str, Callable[[Pipeline, Any], Any]] = {
    "the end of tick_until": lambda loop, value: loop.tick_until(value),
    "an action to mark": lambda loop, value: loop.mark(value),
    "teleop settings": lambda loop, value: loop.change_teleop(value),
    "control settings": lambda loop, value: loop.change_control(value),
    "a distance": lambda loop, value: loop.change_control({"min_distance": value}),
    "a gain": lambda loop, value: loop.change_control({"position_gain": value}),
    "a value beside an unknown name": lambda loop, value: loop.change_control({"unknown": value}),
    "an obstacle's name": lambda loop, value: loop.move_obstacle(value, None),
    "an obstacle": lambda loop, value: loop.move_obstacle("hand", value),
    "an outcome": lambda loop, value: loop.record_outcome(value),
}


@pytest.fixture(scope="module")
def loop() -> Pipeline:
    loop = pipeline(control=ControllerSettings(moving_obstacles=("hand",)))
    loop.begin()
    loop.tick_until(1.0)
    return loop


@pytest.mark.parametrize("call", CALLS.values(), ids=list(CALLS))
def test_a_run_keeps_the_contract_after_a_program_calls_it_with_any_value(
    loop: Pipeline, call: Callable[[Pipeline, Any], Any]
) -> None:
    reference = loop.tick().reference
    contract = Contract(loop.controller, reference.q, reference.v)
    for value in HOSTILE.values():
        with suppress(ConfigError):
            call(loop, value)
        tick = loop.tick()
        contract.check(tick.reference, tick.step)
        loop.check()


@pytest.mark.parametrize("value", HOSTILE.values(), ids=list(HOSTILE))
def test_a_run_refuses_a_duration_that_is_not_a_positive_number(loop: Pipeline, value: Any) -> None:
    if value is None or value is True:
        return
    with pytest.raises(ConfigError, match="duration"):
        loop.run(value, realtime=False)
