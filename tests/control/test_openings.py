"""Fingers that slide or turn are monitored at all openings that they may have.

A change of these openings is accepted only if it is proven to be safe. Coal checks this proof independently.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.config.cell import Config
from q2r2_control.errors import RobotError
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.types import ALL_OF_THE_WAY, Array
from tests.support.coal_distances import coal_distances
from tests.support.driven import Driven
from tests.support.object_cell import ABOVE, BESIDE, CELL, SETTINGS, tips_at
from tests.support.turning_hand import RealHands, above_table, turning_cell

DT = 0.002


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(CELL)


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, SETTINGS)


def closest_by_coal(controller: CartesianController, q: Array) -> float:
    robot = controller.robot
    model = collision_model_at(robot.collision_model, robot.finger_bodies, controller.openings)
    return float(coal_distances(robot, model, q).min())


def height(controller: CartesianController) -> float:
    return float(controller.tool_pose("left").translation[2])


def test_beside_a_block_a_closed_gripper_reaches_a_pose_that_a_gripper_which_may_open_cannot_reach(
    controller: CartesianController,
) -> None:
    run = Driven(controller, dt=2 * DT)
    run.drive(2.0, {"left": BESIDE})
    assert height(controller) > BESIDE.translation[2] + 0.01
    run = Driven(controller, dt=2 * DT)
    assert run.set_opening("left", 0.0, 0.0) is None
    run.drive(2.0, {"left": BESIDE})
    assert height(controller) == pytest.approx(BESIDE.translation[2], abs=5e-4)


def test_a_gripper_may_open_only_partly_beside_a_block_and_may_open_fully_above_the_block(
    controller: CartesianController,
) -> None:
    run = Driven(controller, dt=2 * DT)
    run.set_opening("left", 0.0, 0.0)
    run.drive(2.0, {"left": BESIDE})
    for opening in (1.0, 0.6):
        pair = run.set_opening("left", 0.0, opening)
        assert pair is not None
        assert "block_0" in pair
        assert any("left_hand_e_finger" in name for name in pair)
        assert controller.openings["left"] == (0.0, 0.0)
    assert run.set_opening("left", 0.0, 0.4) is None
    reference = run.drive(0.1, {"left": BESIDE})
    assert reference.report.closest_distance == pytest.approx(closest_by_coal(controller, reference.q), abs=2e-6)
    run.drive(1.5, {"left": ABOVE})
    assert run.set_opening("left", *ALL_OF_THE_WAY) is None
    run.drive(0.1, {"left": ABOVE})


def test_a_moving_gripper_must_not_open_if_its_stop_would_bring_open_fingers_too_close(
    controller: CartesianController,
) -> None:
    """The closed gripper moves towards the block. At every tick, the test requests that it may have all openings.

    If the request is accepted, Coal measures the distances of the open fingers along the stop.
    """
    robot = controller.robot
    kept = kept_distances(robot, SETTINGS).values
    run = Driven(controller)
    run.set_opening("left", 0.0, 0.0)
    run.drive(1.2, {"left": BESIDE})
    run = Driven(controller, run.drive(1.2, {"left": tips_at(0.05, 0.006)}).q)
    run.set_opening("left", 0.0, 0.0)
    answers = []
    for _ in range(150):
        reference = run.drive(DT, {"left": tips_at(0.4, 0.006)})
        q, v = reference.q, reference.v
        room = bool((robot.distance_values(q) >= kept).all())
        accepted = run.set_opening("left", *ALL_OF_THE_WAY) is None
        answers.append((room, accepted))
        stop = controller.stop_deceleration
        for time in np.linspace(0.0, float((np.abs(v) / stop).max()), 20) if accepted else ():
            moving = np.minimum(time, np.abs(v) / stop)
            braked = q + v * moving - 0.5 * np.sign(v) * stop * moving**2
            assert (robot.distance_values(braked) >= kept - 2e-6).all()
        run.set_opening("left", 0.0, 0.0)
    assert answers.count((True, True)) > 10
    assert answers.count((True, False)) > 3
    assert answers.count((False, False)) > 3
    assert (False, True) not in answers


def test_after_a_reset_each_gripper_may_have_any_opening_again(controller: CartesianController) -> None:
    controller.reset(controller.robot.home)
    controller.set_opening("left", 0.2, 0.3)
    assert controller.openings == {"left": (0.2, 0.3), "right": ALL_OF_THE_WAY}
    controller.reset(controller.robot.home)
    assert controller.openings == dict.fromkeys(("left", "right"), ALL_OF_THE_WAY)
    reference = controller.step({}, DT)
    assert reference.report.closest_distance == pytest.approx(closest_by_coal(controller, reference.q), abs=2e-6)
    assert controller.set_opening("left", -0.03, 1.02) is None, "as a sensor may say"
    assert controller.openings["left"] == ALL_OF_THE_WAY


@pytest.mark.parametrize(
    ("arm", "interval", "complaint"),
    [
        ("middle", (0.0, 1.0), "no arm 'middle'; arms: left, right"),
        ("left", (0.6, 0.5), "the least first"),
        ("left", (float("nan"), 1.0), "finite numbers"),
        ("left", (0.0, float("inf")), "finite numbers"),
        ("left", (None, 1.0), "finite numbers"),
    ],
)
def test_an_invalid_opening_or_an_unknown_arm_is_refused_with_the_reason(
    controller: CartesianController, arm: str, interval: tuple[float, float], complaint: str
) -> None:
    with pytest.raises(RobotError, match=complaint):
        controller.set_opening(arm, *interval)


@pytest.mark.parametrize("below", [0.0, 5e-10])
def test_fingers_exactly_at_their_kept_distance_can_move_away_again(robot: Robot, below: float) -> None:
    run = Driven(CartesianController(robot, SETTINGS), dt=2 * DT)
    run.set_opening("left", 0.0, 0.0)
    report = run.drive(2.0, {"left": BESIDE}).report
    assert "finger" in report.closest_pair[0] + report.closest_pair[1]
    kept = SETTINGS.distances.model_copy(update={"finger_obstacle": report.closest_distance + below})
    near = Driven(CartesianController(robot, SETTINGS.model_copy(update={"distances": kept})), run.q, dt=2 * DT)
    near.set_opening("left", 0.0, 0.0)
    reference = near.drive(2.0, {"left": ABOVE})
    assert not reference.report.fallback
    assert np.linalg.norm(near.controller.tool_pose("left").translation - ABOVE.translation) < 1e-3


COAL = 2e-6  # Largest difference between our distances and Coal's distances [m].


class Cell(Driven):
    """A run that checks the contract, and measures distances with the real positions of the fingers."""

    def __init__(self, config: Config) -> None:
        # The solver has no time limit, so that no result depends on the speed of the computer.
        robot, settings = Robot.from_config(config), config.control.model_copy(update={"solve_time_limit": None})
        self.real, self.kept = RealHands(robot), kept_distances(robot, settings).values
        super().__init__(CartesianController(robot, settings), dt=DT)

    def spare(self, openings: dict[str, float]) -> float:
        """Return the least margin of a pair [m], measured with the real shapes of the fingers at ``openings``."""
        return float((self.real.distances(self.q, openings) - self.kept).min())

    def spare_of_bodies(self) -> float:
        """Return the least margin of a pair [m], measured with the fingers' bodies for the accepted openings."""
        model = collision_model_at(self.robot.collision_model, self.robot.finger_bodies, self.controller.openings)
        return float((coal_distances(self.robot, model, self.q) - self.kept).min())


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    return Cell(turning_cell(tmp_path))


def test_an_open_gripper_must_not_close_near_the_table_and_may_close_higher_above_it(cell: Cell) -> None:
    assert cell.set_opening("left", 1.0, 1.0) is None
    cell.drive(1.8, {"left": above_table(0.006)})
    # The tips of the closed fingers would be 8 mm inside the table.
    assert cell.spare({"left": 1.0, "right": 1.0}) > 0.0 > cell.spare({"left": 0.0, "right": 1.0})
    for least in (0.0, 0.3):
        pair = cell.set_opening("left", least, 1.0)
        assert pair is not None
        assert "table_0" in pair
        assert any("_tip" in name for name in pair)
        assert cell.controller.openings["left"] == (1.0, 1.0)
    assert cell.set_opening("left", 0.95, 1.0) is None
    cell.drive(1.2, {"left": above_table(0.06)})
    assert cell.set_opening("left", *ALL_OF_THE_WAY) is None
    cell.drive(0.02, {"left": above_table(0.06)})


def test_a_narrower_interval_of_openings_is_refused_if_its_capsule_would_be_too_close_to_the_table(cell: Cell) -> None:
    """Capsules for the narrower interval extend farther towards the table, because the gripper is tilted."""
    wide, narrow, direction = (0.0, 0.7), (0.175, 0.7), np.array([-0.1135, 0.3231, 0.9395])
    fingers = [body for body in cell.robot.finger_bodies if isinstance(body, TurningBody) and body.arm == "left"]
    reach = {}
    for interval in (wide, narrow):
        capsules = [body.capsule(interval) for body in fingers]
        reach[interval] = max(max(start @ direction, end @ direction) + radius for start, end, radius in capsules)
    assert reach[narrow] > reach[wide] + 0.0007
    assert cell.set_opening("left", *wide) is None
    home = cell.controller.tool_pose("left")
    data = cell.robot.model.createData()
    pin.forwardKinematics(cell.robot.model, data, cell.robot.home)
    pointed = data.oMi[int(cell.robot.arms["left"].joints[-1]) + 1].rotation @ direction
    tilt = pin.Quaternion.FromTwoVectors(pointed, np.array([0.0, 0.0, -1.0])).matrix()
    low, high = (pin.SE3(tilt @ home.rotation, np.array([0.5, 0.25, height])) for height in (0.15, 0.3))
    cell.drive(1, {"left": high})
    cell.drive(1.8, {"left": low})
    pair = cell.set_opening("left", *narrow)
    assert pair is not None
    assert "table_0" in pair
    assert cell.controller.openings["left"] == wide
    # The capsules for openings from 0.3 to 0.4 lie within the capsules for the wider interval.
    assert cell.set_opening("left", 0.3, 0.4) is None
    assert cell.spare_of_bodies() >= -COAL
    assert cell.set_opening("left", *wide) is None
    cell.drive(0.4, {"left": high})
    assert cell.set_opening("left", *narrow) is None


@pytest.mark.slow
def test_with_hostile_targets_and_openings_no_finger_is_too_close_at_its_real_position(cell: Cell) -> None:
    random, refused = np.random.default_rng(5), 0
    goals: dict[str, pin.SE3] = {}
    for tick in range(1500):
        if tick % 150 == 0:
            for arm, side in (("left", 1.0), ("right", -1.0)):
                height = random.choice([0.1, 0.21, 0.23, 0.3])
                place = np.array([random.uniform(0.4, 0.6), side * random.uniform(-0.15, 0.2), height])
                tilt = pin.rpy.rpyToMatrix(np.pi + random.uniform(-0.6, 0.6), random.uniform(-0.3, 0.3), np.pi)
                goals[arm] = pin.SE3(tilt, place)
        if random.random() < 0.2:
            low, high = np.sort(random.random(2)).tolist()
            interval = ((low, high), (low, 1.0), (0.0, high), ALL_OF_THE_WAY)[random.integers(4)]
            stop = cell.controller.stop_deceleration
            refused += cell.set_opening(str(random.choice(["left", "right"])), *interval) is not None
            # The arms possibly brake along this stop already, so the stop must not change.
            np.testing.assert_array_equal(cell.controller.stop_deceleration, stop)
        cell.drive(DT, goals)
        if tick % 8 == 0:
            for share in (0.0, 1.0, float(random.random())):
                at = {arm: least + share * (most - least) for arm, (least, most) in cell.controller.openings.items()}
                assert cell.spare(at) >= -COAL
            assert cell.spare_of_bodies() >= -COAL
    assert refused > 10
