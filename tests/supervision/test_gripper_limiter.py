"""A gripper moves only as far as the controller has proven to be safe.

The controller knows the gripper's opening, and whether the gripper holds an object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.plants.base import GripperMotion
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.supervision.gripper_limiter import TOLERANCE, GraspWatch, Grip, GripperLimiter
from q2r2_control.types import ALL_OF_THE_WAY
from tests.supervision.conftest import unhurried
from tests.support.object_cell import ABOVE, BESIDE, BLOCK, CELL, SETTINGS, cell
from tests.support.turning_hand import RealHands, above_table, turning_cell

DT = 0.002
STROKE = 0.025  # [m]


@pytest.fixture(scope="module")
def controller() -> CartesianController:
    return CartesianController(Robot.from_config(CELL), SETTINGS)


class Cell:
    """Arms that are always at their reference, with grippers that move to their commands at their own speed."""

    def __init__(self, controller: CartesianController) -> None:
        controller.reset(controller.robot.home)
        self.controller, self.limiter = controller, GripperLimiter(controller)
        self.motion, self.now, self.asked = GripperMotion(CELL), 0.0, 0
        self.granted: dict[str, float] = {}

    def run(self, wanted: float, seconds: float, goal: pin.SE3 | None = None) -> None:
        for _ in range(round(seconds / DT)):
            before = self.controller.openings
            self.tick(wanted, self.motion.openings)
            self.asked += self.controller.openings != before
            self.controller.step({"left": goal}, DT)
            self.motion.command(self.granted)
            self.motion.advance(DT)
            least, greatest = self.controller.openings["left"]
            for opening in (self.granted["left"], self.motion.openings["left"]):
                # The interval contains half of the tolerance on each side of the opening.
                assert least <= max(opening - 0.5 * TOLERANCE / STROKE, 0.0)
                assert greatest >= min(opening + 0.5 * TOLERANCE / STROKE, 1.0)
            assert self.controller.openings["right"][1] == 1.0

    def tick(self, wanted: float, measured: Mapping[str, float]) -> None:
        self.now += DT
        self.granted = self.limiter.limit({"left": wanted, "right": 1.0}, measured, self.now)
        assert self.granted["right"] == 1.0


@pytest.fixture
def gripper(controller: CartesianController) -> Cell:
    return Cell(controller)


def test_the_interval_of_openings_shrinks_around_a_closed_gripper_and_does_not_change_while_it_rests(
    gripper: Cell,
) -> None:
    gripper.run(0.0, 0.5)
    assert gripper.granted["left"] == gripper.motion.openings["left"] == 0.0
    assert gripper.controller.openings["left"][0] == 0.0
    assert gripper.controller.openings["left"][1] == pytest.approx(TOLERANCE / STROKE)
    asked = gripper.asked
    gripper.run(0.0, 0.2)
    assert gripper.asked == asked < 12


def test_a_gripper_opens_as_far_as_is_proven_safe_and_tries_every_5_ms_to_open_farther(gripper: Cell) -> None:
    gripper.run(0.0, 1.6, BESIDE)
    assert not gripper.limiter.held
    gripper.run(1.0, 0.4, BESIDE)
    assert 0.35 < gripper.granted["left"] < 0.5
    assert gripper.motion.openings["left"] == pytest.approx(gripper.granted["left"])
    assert "block_0" in gripper.limiter.held["left"]
    with patch.object(gripper.controller, "set_opening", wraps=gripper.controller.set_opening) as asked:
        gripper.run(1.0, 0.1, BESIDE)
    assert 10 <= asked.call_count <= 0.1 / 0.005 + 1
    gripper.run(0.0, DT, BESIDE)
    assert gripper.granted["left"] == 0.0
    assert not gripper.limiter.held
    gripper.run(1.0, 0.4, BESIDE)
    gripper.run(1.0, 1.0, ABOVE)
    assert gripper.granted["left"] == gripper.motion.openings["left"] == 1.0
    assert not gripper.limiter.held


def test_without_a_measurement_a_gripper_gets_its_commands_and_its_fingers_are_monitored_at_all_openings(
    gripper: Cell,
) -> None:
    for wanted in (1.0, 0.0, 0.5):
        gripper.tick(wanted, {})
        assert gripper.granted == {"left": wanted, "right": 1.0}
    assert gripper.controller.openings == dict.fromkeys(("left", "right"), ALL_OF_THE_WAY)


@pytest.mark.parametrize("measured", [{}, {"left": math.nan}, {"left": 7.0}], ids=["none", "no number", "absurd"])
def test_without_a_trusted_measurement_a_gripper_keeps_its_last_command(
    gripper: Cell, measured: dict[str, float]
) -> None:
    gripper.run(0.0, 0.5)
    openings = gripper.controller.openings
    for _ in range(100):
        gripper.tick(1.0, measured)
        assert gripper.granted["left"] == 0.0
    assert gripper.controller.openings == openings


@pytest.mark.parametrize(("start", "wanted", "measured"), [(0.0, 1.0, -0.1), (1.0, 0.0, 1.1)])
def test_a_finger_slightly_beyond_its_calibrated_end_can_still_be_moved(
    gripper: Cell, start: float, wanted: float, measured: float
) -> None:
    gripper.run(start, 0.5)
    for _ in range(50):
        gripper.tick(wanted, {"left": measured})
    assert gripper.granted["left"] == wanted


def test_the_body_beside_a_gripper_that_was_forced_open_is_named_and_the_gripper_may_close(gripper: Cell) -> None:
    gripper.run(0.0, 1.6, BESIDE)
    openings = gripper.controller.openings["left"]
    for _ in range(20):
        gripper.tick(0.0, {"left": 0.9, "right": 1.0})
    assert "block_0" in gripper.limiter.held["left"]
    assert gripper.controller.openings["left"] == openings
    gripper.run(0.4, 0.2, BESIDE)
    for wanted in (0.4, 0.1, 0.0):
        gripper.tick(wanted, {"left": 0.9, "right": 1.0})
        assert gripper.granted["left"] == wanted


def test_after_resume_a_gripper_is_monitored_at_once_from_its_commanded_to_its_measured_opening(
    controller: CartesianController,
) -> None:
    controller.reset(controller.robot.home)
    limiter = GripperLimiter(controller)
    limiter.resume({"left": 0.0, "right": 0.3}, {"left": 0.2, "right": math.nan}, 1.0)
    assert controller.openings["left"] == pytest.approx((0.0, 0.2 + TOLERANCE / STROKE))
    assert controller.openings["right"] == ALL_OF_THE_WAY
    granted = limiter.limit({"left": 0.0, "right": 1.0}, {"left": 0.1, "right": 1.0}, 1.0 + DT)
    assert granted == {"left": 0.0, "right": 1.0}
    assert controller.openings["left"][1] < 0.3


def test_an_earlier_opening_is_monitored_until_the_longest_delay_of_the_gripper_has_passed(
    controller: CartesianController,
) -> None:
    least = {}
    for remembered in (0.05, 0.3):
        controller.reset(controller.robot.home)
        limiter, now = GripperLimiter(controller, remembered), 0.0
        while controller.openings["left"][1] == 1.0:
            now += DT
            limiter.limit({"left": 0.0 if now > 0.01 else 1.0}, {"left": 0.0}, now)
        least[remembered] = now
    assert 0.05 <= least[0.05] < 0.15
    assert 0.3 <= least[0.3] < 0.7


def test_turning_fingers_close_only_as_far_as_the_table_allows_and_go_on_when_the_arm_rises(tmp_path: Path) -> None:
    config = turning_cell(tmp_path)
    robot = Robot.from_config(config)
    real = RealHands(robot)
    controller = CartesianController(robot, config.control.model_copy(update={"solve_time_limit": None}))
    kept = kept_distances(robot, config.control).values
    limiter, motion, now = GripperLimiter(controller), GripperMotion(config), 0.0

    def run(wanted: float, goal: pin.SE3, seconds: float) -> None:
        nonlocal now
        for tick in range(round(seconds / DT)):
            now += DT
            granted = limiter.limit({"left": wanted, "right": 1.0}, motion.openings, now)
            reference = controller.step({"left": goal}, DT)
            motion.command(granted)
            motion.advance(DT)
            for opening in (granted["left"], motion.openings["left"]):
                assert controller.openings["left"][0] <= opening <= controller.openings["left"][1]
            if tick % 10 == 0:
                assert (real.distances(reference.q, motion.openings) >= kept - 2e-6).all()

    run(1.0, above_table(0.006), 1.8)
    assert not limiter.held
    run(0.0, above_table(0.006), 0.6)
    assert 0.3 < motion.openings["left"] < 0.95
    assert "table_0" in limiter.held["left"]
    run(0.0, above_table(0.06), 1.5)
    assert motion.openings["left"] == 0.0
    assert not limiter.held
    # Closed fingers reach farther down than open ones. Therefore the arm stops above its target.
    run(0.0, above_table(0.006), 1.0)
    assert controller.tool_pose("left").translation[2] > above_table(0.006).translation[2] + 0.005


def test_a_closed_gripper_is_not_reported_as_limited_if_its_interval_of_openings_is_not_allowed_to_shrink(
    gripper: Cell,
) -> None:
    controller = gripper.controller
    gripper.run(0.0, 0.05)
    with patch.object(controller, "set_opening", return_value=("finger", "table")):
        gripper.run(0.0, 0.4)
        assert not gripper.limiter.held
    assert gripper.motion.openings["left"] == gripper.granted["left"] == 0.0
    assert controller.openings["left"][1] == 1.0
    gripper.run(0.0, 0.2)
    assert controller.openings["left"][1] < 0.1


BLOCK_CELL, TICK = cell(BLOCK), 0.004


@pytest.fixture(scope="module")
def holder() -> CartesianController:
    return CartesianController(Robot.from_config(BLOCK_CELL), unhurried(BLOCK_CELL))


class Hand:
    """A left gripper that closes at its speed, but no farther than the object between its fingers allows."""

    def __init__(self, holder: CartesianController) -> None:
        self.holder, self.watch = holder, GraspWatch(holder)
        self.opening, self.now, self.changes = 1.0, 0.0, 0

    def run(self, wanted: float, seconds: float, least: float = 0.0, measured: float | None = None) -> bool:
        for _ in range(round(seconds / TICK)):
            self.now += TICK
            self.opening += min(max(max(wanted, least) - self.opening, -4.0 * TICK), 4.0 * TICK)
            seen = {"left": self.opening if measured is None else measured, "right": 1.0}
            self.changes += self.watch.update({"left": wanted, "right": 0.0}, seen, self.now)
        return self.holder.holding["left"]


@pytest.fixture
def hand(holder: CartesianController) -> Hand:
    holder.reset(holder.robot.home)
    return Hand(holder)


def test_a_gripper_holds_a_block_from_the_standstill_of_its_fingers_until_the_block_slips_out(hand: Hand) -> None:
    assert not hand.run(0.0, 0.2, least=0.8)
    assert hand.run(0.0, 0.2, least=0.8)
    assert hand.run(0.0, 1.0, least=0.8)
    assert hand.changes == 1
    assert not hand.run(0.0, 0.5)


@pytest.mark.parametrize("least", [0.0, 0.06], ids=["nothing", "1.5 mm"])
def test_a_gripper_that_closes_fully_or_nearly_fully_holds_no_object(hand: Hand, least: float) -> None:
    assert not hand.run(0.0, 1.5, least=least)


def test_an_object_of_2_5_mm_is_held_and_stays_held_while_it_is_squeezed_to_1_25_mm(hand: Hand) -> None:
    assert hand.run(0.0, 1.0, least=0.1)
    assert hand.run(0.0, 0.5, least=0.05)
    assert not hand.run(0.0, 0.5, least=0.03), "0.75 mm are no object"


def test_an_object_is_held_although_the_measured_opening_is_noisy(hand: Hand) -> None:
    for noise in (0.25e-3 / STROKE, 0.0) * 30:
        held = hand.run(0.0, TICK, measured=0.8 + noise)
    assert held


def test_a_gripper_holds_no_object_while_it_closes_slowly(hand: Hand) -> None:
    for step in range(100):
        assert not hand.run(0.0, TICK, least=1.0 - 0.01 * step)


def test_without_measurements_a_gripper_counts_as_holding_an_object_if_it_last_held_one(hand: Hand) -> None:
    assert not hand.run(0.0, 0.5, measured=math.nan)
    hand.run(0.0, 0.5, least=0.8)
    assert hand.run(0.0, 0.5, measured=math.nan)
    assert hand.run(1.0, 0.5, measured=math.nan)


def test_a_gripper_without_measured_opening_counts_as_holding_while_its_command_is_less_than_half_open() -> None:
    """The cell names no joints for the left gripper."""
    data = BLOCK_CELL.model_dump()
    data["arms"]["left"]["gripper"]["joints"] = ()
    bare = type(BLOCK_CELL).model_validate(data)
    controller, held = CartesianController(Robot.from_config(bare), unhurried(bare)), []
    watch = GraspWatch(controller)
    for wanted in (1.0, 0.0, 0.45, 0.55):
        watch.update({"left": wanted, "right": wanted}, {}, 0.0)
        held.append(controller.holding["left"])
    assert held == [False, True, True, False]


def test_a_gripper_holds_an_object_only_after_its_fingers_have_stood_still_for_the_stall_time() -> None:
    for stall in (0.2, 0.5):
        grip = Grip(0.025, stall)
        held = [at for at in np.arange(0.0, 1.0, 0.01) if grip.look(0.0, 1.0, float(at))]
        assert stall <= held[0] < stall + 0.03


def test_a_controller_that_was_reset_learns_at_once_which_objects_are_held(hand: Hand) -> None:
    assert hand.run(0.0, 0.5, least=0.8)
    hand.holder.reset(hand.holder.robot.home)
    assert not hand.holder.holding["left"]
    hand.watch.tell_again()
    assert hand.holder.holding["left"]
