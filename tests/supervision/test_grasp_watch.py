"""A gripper holds that is to close farther and does not, until it is opened or has closed after all."""

from __future__ import annotations

import math

import numpy as np
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.supervision.gripper_limiter import GraspWatch, Grip
from tests.supervision.conftest import unhurried
from tests.support.object_cell import BLOCK, cell

DT = 0.004
CELL = cell(BLOCK)


@pytest.fixture(scope="module")
def built() -> CartesianController:
    return CartesianController(Robot.from_config(CELL), unhurried(CELL))


@pytest.fixture
def controller(built: CartesianController) -> CartesianController:
    built.reset(built.robot.home)
    return built


class Hand:
    """A left gripper that closes at its speed, but no farther than to what is between its fingers."""

    def __init__(self, controller: CartesianController) -> None:
        self.controller, self.watch = controller, GraspWatch(controller)
        self.opening, self.now, self.changes = 1.0, 0.0, 0

    def run(self, wanted: float, seconds: float, least: float = 0.0, measured: float | None = None) -> bool:
        for _ in range(round(seconds / DT)):
            self.now += DT
            goal = max(wanted, least)
            self.opening += min(max(goal - self.opening, -4.0 * DT), 4.0 * DT)
            seen = {"left": self.opening if measured is None else measured, "right": 1.0}
            self.changes += self.watch.update({"left": wanted, "right": 0.0}, seen, self.now)
        return self.controller.holding["left"]


def test_closed_on_a_block_it_holds_once_its_fingers_stand_still(controller: CartesianController) -> None:
    hand = Hand(controller)
    assert not hand.run(0.0, 0.2, least=0.8)
    assert hand.run(0.0, 0.2, least=0.8)
    assert hand.run(0.0, 1.0, least=0.8)
    assert hand.changes == 1


def test_what_slips_out_is_held_no_more(controller: CartesianController) -> None:
    hand = Hand(controller)
    assert hand.run(0.0, 0.5, least=0.8)
    assert not hand.run(0.0, 0.5)


@pytest.mark.parametrize("least", [0.0, 0.06], ids=["nothing", "1.5 mm"])
def test_a_gripper_that_closes_fully_or_nearly_holds_nothing(controller: CartesianController, least: float) -> None:
    assert not Hand(controller).run(0.0, 1.5, least=least)


def test_one_that_closes_slowly_holds_nothing_on_the_way(controller: CartesianController) -> None:
    hand = Hand(controller)
    for step in range(100):
        assert not hand.run(0.0, DT, least=1.0 - 0.01 * step)


def test_while_nothing_is_measured_what_was_known_stays(controller: CartesianController) -> None:
    hand = Hand(controller)
    assert not hand.run(0.0, 0.5, measured=math.nan)
    hand.run(0.0, 0.5, least=0.8)
    assert hand.run(0.0, 0.5, measured=math.nan)
    assert hand.run(1.0, 0.5, measured=math.nan)


def test_where_no_opening_is_measured_a_closed_gripper_holds() -> None:
    """A gripper of which the cell has no joints."""
    data = CELL.model_dump()
    data["arms"]["left"]["gripper"]["joints"] = ()
    bare = type(CELL).model_validate(data)
    controller = CartesianController(Robot.from_config(bare), unhurried(bare))
    watch = GraspWatch(controller)
    held = []
    for wanted in (1.0, 0.0, 0.0, 1.0):
        watch.update({"left": wanted, "right": wanted}, {}, 0.0)
        held.append(controller.holding["left"])
    assert held == [False, True, True, False]


def test_a_gripper_that_may_begin_late_is_given_that_time() -> None:
    for stall in (0.2, 0.5):
        grip = Grip(0.025, stall)
        held = [at for at in np.arange(0.0, 1.0, 0.01) if grip.look(0.0, 1.0, float(at))]
        assert stall <= held[0] < stall + 0.03


def test_a_controller_that_was_reset_is_told_at_once_of_what_is_held(controller: CartesianController) -> None:
    hand = Hand(controller)
    assert hand.run(0.0, 0.5, least=0.8)
    controller.reset(controller.robot.home)
    assert not controller.holding["left"]
    hand.watch.tell_again()
    assert controller.holding["left"]
