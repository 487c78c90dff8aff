"""Parameters that are set while an arm moves: no jump, what counts from then on, what is refused as a whole and why."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes
from tests.ros.waiting import wait_until

need_ros()

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from tests.ros.arm_rig import ArmRig, assert_same, offset, steps


class Settable(ArmRig):
    """An arm whose node's parameters can be set and read."""

    def __init__(self, node: Any, arm: str = "left") -> None:
        super().__init__(node, arm)
        self._client = AsyncParameterClient(node, f"{arm}_q2r2_arm_controller")

    def set(self, **values: Any) -> Any:
        """Of ``teleop`` all together, ``__`` stands for a dot; the result, with ``successful`` and ``reason``."""
        return self.set_named({"teleop." + name.replace("__", "."): value for name, value in values.items()})

    def set_named(self, values: dict[str, Any]) -> Any:
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        future = self._client.set_parameters_atomically(parameters)
        wait_until(future.done, "the parameters are answered")
        return future.result().result

    def get(self, name: str) -> float:
        future = self._client.get_parameters([f"teleop.{name}"])
        wait_until(future.done, "the parameters are answered")
        return float(future.result().values[0].double_value)


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes) -> Settable:
    rig = Settable(module_node)
    rig.start(module_processes)
    return rig


@pytest.fixture
def rig(started: Settable) -> Settable:
    if not started.state["engaged"]:
        started.engage()
    started.wait_for_rest()
    return started


def test_a_scale_that_is_set_in_motion_counts_from_then_on_and_nothing_jumps(rig: Settable) -> None:
    before = rig.wait_for_rest()
    assert rig.set(position_scale=0.5, filter__smoothing_delay=0.05).successful
    rig.move((0.1, 0.0, 0.0))
    assert_same(rig.wait_for_rest(), offset(before, (0.05, 0.0, 0.0)), 1e-3)
    assert rig.state["engaged"]
    assert max(steps(rig.targets)) < 0.01
    assert rig.get("position_scale") == 0.5
    assert rig.set(position_scale=1.0).successful


def test_what_cannot_be_set_is_refused_with_the_reason_and_changes_nothing(rig: Settable) -> None:
    before = rig.wait_for_rest()
    for values, reason in (
        ({"position_scale": 0.5, "chord_window": 0.2}, "may be changed while both arms hold"),
        ({"position_scale": 0.5, "precision_scale": 7.0}, "precision_scale"),
        ({"position_scale": 0.5, "axis_scales": [1.0, 2.0]}, "teleop.axis_scales"),
    ):
        result = rig.set(**values)
        assert not result.successful
        assert reason in result.reason
        assert rig.get("position_scale") == 1.0
    rig.move((0.05, 0.0, 0.0))
    assert_same(rig.wait_for_rest(), offset(before, (0.05, 0.0, 0.0)), 1e-3)


def test_a_target_is_as_slow_as_the_guard_is_set_to_in_motion(rig: Settable) -> None:
    before = rig.wait_for_rest()
    assert rig.set_named({"guard.max_velocity": 0.05, "guard.max_acceleration": 2.0}).successful
    began = time.monotonic()
    rig.move((0.06, 0.0, 0.0))
    way = np.linalg.norm(rig.newest().translation - before.translation)
    assert way < 0.05 * (time.monotonic() - began)  # of 0.06 m, which the hand has gone
    goal = offset(before, (0.06, 0.0, 0.0)).translation
    rig.wait(lambda: np.linalg.norm(rig.newest().translation - goal) < 1e-3, "the target is where the hand is")
    refused = rig.set_named({"guard.max_velocity": 0.5, "guard.max_angular_velocity": 0.0})
    assert not refused.successful
    assert "guard.max_angular_velocity" in refused.reason


def test_mirror_is_set_while_the_arm_is_paused_and_gives_it_the_other_hand(rig: Settable) -> None:
    refused = rig.set_named({"mirror": True})
    assert not refused.successful
    assert "may be changed while both arms hold" in refused.reason
    rig.pause()
    refused = rig.set_named({"mirror_reflected": True})
    assert not refused.successful
    assert "allowed with mirror = True only" in refused.reason
    assert rig.state["hand"] == "left"
    assert rig.set_named({"mirror": True, "mirror_reflected": True}).successful
    rig.wait(lambda: rig.state["stance"] == "mirror_reflected", "the stance is told")
    assert rig.state["hand"] == "right"
    assert rig.set_named({"mirror": False, "mirror_reflected": False}).successful
    rig.wait(lambda: rig.state["hand"] == "left", "the hand is its own again")
    rig.engage()
