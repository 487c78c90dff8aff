"""Grippers in the whole loop: they close and open, are monitored at their real opening, and hold objects."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.fri import MODBUS_DELAY, CabinetConfig, ModbusGripperConfig
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.gripper_limiter import GripperLimiter
from q2r2_control.types import Command, HandSample
from tests.pipeline.loops import pipeline
from tests.support.object_cell import cell as object_cell
from tests.support.processes import Watch, cell


@pytest.mark.slow
def test_fingers_are_monitored_at_the_opening_of_their_gripper_at_every_tick() -> None:
    loop = pipeline(ScriptedInput("meet"), "mujoco")
    watch, widest = Watch(loop), list[float]()

    def listener(tick: Tick) -> None:
        for arm, (least, greatest) in loop.controller.openings.items():
            assert least <= tick.grippers[arm] <= greatest
        widest.append(loop.controller.openings["left"][1])

    loop.listeners.append(listener)
    summary = loop.run(5.6, realtime=False)
    # At the end, the left gripper has closed on a block. Therefore it is monitored at a smaller opening.
    assert widest[0] == 1.0
    assert widest[-1] < 0.9
    assert widest[-1] == pytest.approx(watch.ticks[-1].grippers["left"] + 0.04, abs=0.02)
    assert summary.fallback_ticks == summary.uncertified_ticks == 0
    assert all(not figures.gripper_held_s for figures in summary.arms.values())
    assert len(watch.ticks) == len(widest)


class SeldomAskedGrippers(KinematicPlant):
    """A plant whose grippers are commanded and read as seldom as Modbus grippers may be."""

    _measured: dict[str, float] | None = None
    _asked = 0.0

    def apply(self, command: Command) -> None:
        if self._measured is None or self._time - self._asked >= 0.8 * MODBUS_DELAY:
            self._asked, self._measured, self._granted = self._time, self.openings, dict(command.grippers)
        super().apply(replace(command, grippers=self._granted))

    @property
    def openings(self) -> dict[str, float]:
        return super().gripper_openings()

    def gripper_openings(self) -> dict[str, float]:
        return self._measured or self.openings


def test_fingers_are_monitored_at_their_opening_even_if_the_gripper_is_read_seldom() -> None:
    config, hands = cell(), LeftUpperPresses("circle")
    hands.again = 1.25  # The second press comes while the gripper is half closed.
    slow = {
        side: arm.model_copy(update={"gripper": arm.gripper.model_copy(update={"speed": 0.05})})
        for side, arm in config.arms.items()
    }
    left = CabinetConfig(gripper=ModbusGripperConfig(modbus="gripper"))
    config = config.model_copy(update={"arms": slow, "fri": {"left": left}, "loop_rate_hz": 500.0})
    plant = SeldomAskedGrippers(Robot.from_config(config), config)
    loop, seen = Pipeline.from_config(config, input=hands, plant=plant), list[float]()

    def listener(tick: Tick) -> None:
        seen.append(plant.openings["left"])
        least, greatest = loop.controller.openings["left"]
        assert least <= seen[-1] <= greatest, f"at {tick.t:.3f} s"

    loop.listeners.append(listener)
    loop.run(1.8, realtime=False)
    assert min(seen) < 0.6
    assert seen[-1] > 0.9


@pytest.mark.slow
def test_a_gripped_object_counts_as_a_part_of_the_tool_until_it_is_put_down() -> None:
    """The object is the flat block of the demo. The contract, which covers held objects, is checked at every tick."""
    flat = {"box": (0.06, 0.04, 0.015), "at": (0.0, 0.0, 0.0085), "mass": 0.1}
    config = object_cell(None, flat).model_copy(update={"loop_rate_hz": 500.0})
    loop = Pipeline.from_config(config, input=ScriptedInput("grasp"), plant="mujoco")
    watch = Watch(loop)
    summary = loop.run(10.0, realtime=False)
    held = [tick.t for tick in watch.ticks if tick.holding["right"]]
    assert 4.0 < held[0] < 5.0
    assert 8.5 < held[-1] < 9.5
    assert summary.arms["right"].object_held_s == pytest.approx(held[-1] - held[0], abs=0.01)
    assert summary.arms["left"].object_held_s is None
    assert summary.fallback_ticks == summary.uncertified_ticks == 0
    jumps = [np.abs(second.reference.v - first.reference.v).max() for first, second in pairwise(watch.ticks)]
    gripped = next(i for i, tick in enumerate(watch.ticks) if tick.holding["right"])
    # No velocity jumps at the grasp [rad/s]. The averaged pose of the resting hand may still move the arm a little.
    assert max(jumps[gripped - 1 : gripped + 20]) < 5e-4


def test_a_new_run_does_not_compensate_the_weight_of_an_object_that_was_held_in_the_last_run() -> None:
    config = object_cell({"mass": 2.0})
    loop = Pipeline.from_config(config, input=ScriptedInput("circle"), plant="mujoco", mode="torque")
    drive: Any = loop.drive
    drive.set_holding({"left": True})
    drive.reset(loop.plant.state())
    home, model = loop.robot.home, loop.robot.model
    bare = pin.computeGeneralizedGravity(model, model.createData(), home)
    assert np.abs(drive.impedance.gravity(home) - bare).max() > 1.0
    loop.run(0.01, realtime=False)
    np.testing.assert_allclose(drive.impedance.gravity(home), bare, atol=1e-9)


class LeftUpperPresses(ScriptedInput):
    """The left hand presses its upper button at 1.0 s, moves, and presses the button again at the time ``again``."""

    again = 1.6  # Time of the second press [s].

    def poll(self, now: float) -> list[HandSample]:
        held = 1.0 <= now < 1.1 or self.again <= now < self.again + 0.1
        return [
            replace(sample, inputs=replace(sample.inputs, button_upper=held)) if sample.hand == "left" else sample
            for sample in super().poll(now)
        ]


@pytest.mark.slow
def test_a_gripper_that_is_not_allowed_to_close_fully_does_not_count_as_holding_an_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(GripperLimiter, "limit", lambda *_: {"left": 0.5, "right": 1.0})
    loop = Pipeline.from_config(object_cell({}), input=LeftUpperPresses("circle"), plant="mujoco")
    watch = Watch(loop)
    loop.run(1.55, realtime=False)
    assert watch.ticks[-1].targets["left"].gripper == 0.0
    assert loop.plant.gripper_openings()["left"] == pytest.approx(0.5, abs=0.05)
    assert not any(tick.holding["left"] for tick in watch.ticks)
