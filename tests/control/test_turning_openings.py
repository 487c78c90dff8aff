"""Fingers that turn count at the openings that they may have; more and less is proven first, and shown by Coal."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.config.cell import Config
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.types import ALL_OF_THE_WAY, Interval
from q2r2_control.verification.contract import Contract
from tests.support.coal_distances import coal_distances
from tests.support.turning_hand import RealHands, above_table, turning_cell

DT = 0.002
COAL = 2e-6  # how exactly our distances are Coal's [m]


class Cell:
    """A controller with its contract, and its fingers as they really are."""

    def __init__(self, config: Config) -> None:
        # No outcome hangs on the clock.
        robot, settings = Robot.from_config(config), config.control.model_copy(update={"solve_time_limit": None})
        self.robot, self.real, self.controller = robot, RealHands(robot), CartesianController(robot, settings)
        self.kept = kept_distances(robot, settings).values
        self.start()

    def start(self) -> None:
        self.controller.reset(self.robot.home)
        self.contract, self.q = Contract(self.controller, self.robot.home), self.robot.home

    def set_opening(self, least: float, greatest: float, arm: str = "left") -> tuple[str, str] | None:
        refused = self.controller.set_opening(arm, least, greatest)
        self.contract.set_openings(self.controller.openings)
        return refused

    def drive(self, targets: dict[str, pin.SE3], ticks: int = 1) -> None:
        for _ in range(ticks):
            reference = self.controller.step(targets, DT)
            self.contract.check(reference, DT)
        self.q = reference.q

    def spare(self, openings: dict[str, float]) -> float:
        """How much farther apart than it has to be the nearest pair of shapes as drawn is [m]."""
        return float((self.real.distances(self.q, openings) - self.kept).min())

    def spare_of_bodies(self, openings: dict[str, Interval]) -> float:
        """The same of the fingers' bodies."""
        model = collision_model_at(self.robot.collision_model, self.robot.finger_bodies, openings)
        return float((coal_distances(self.robot, model, self.q) - self.kept).min())


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return Cell(turning_cell(tmp_path_factory.mktemp("hand")))


def test_an_open_gripper_may_not_close_into_the_table_and_may_where_there_is_room(cell: Cell) -> None:
    cell.start()
    assert cell.set_opening(1.0, 1.0) is None
    cell.drive({"left": above_table(0.006)}, 900)
    # The closed fingers' tips would be 8 mm inside the table.
    assert cell.spare({"left": 1.0, "right": 1.0}) > 0.0 > cell.spare({"left": 0.0, "right": 1.0})
    for least in (0.0, 0.3):
        pair = cell.set_opening(least, 1.0)
        assert pair is not None
        assert "table_0" in pair
        assert any("_tip" in name for name in pair)
        assert cell.controller.openings["left"] == (1.0, 1.0)
    assert cell.set_opening(0.95, 1.0) is None
    cell.drive({"left": above_table(0.06)}, 600)
    assert cell.set_opening(*ALL_OF_THE_WAY) is None
    cell.drive({"left": above_table(0.06)}, 10)


def test_less_that_reaches_nearer_is_refused_like_more_and_the_wider_body_stays(cell: Cell) -> None:
    """Onto the table along a direction in which the capsules of a part of an interval reach farther than of all."""
    wide, narrow, direction = (0.0, 0.7), (0.175, 0.7), np.array([-0.1135, 0.3231, 0.9395])
    fingers = [body for body in cell.robot.finger_bodies if isinstance(body, TurningBody) and body.arm == "left"]
    reach = {}
    for interval in (wide, narrow):
        capsules = [body.capsule(interval) for body in fingers]
        reach[interval] = max(max(start @ direction, end @ direction) + radius for start, end, radius in capsules)
    assert reach[narrow] > reach[wide] + 0.0007
    cell.start()
    assert cell.set_opening(*wide) is None
    home = cell.controller.tool_pose("left")
    data = cell.robot.model.createData()
    pin.forwardKinematics(cell.robot.model, data, cell.robot.home)
    pointed = data.oMi[int(cell.robot.arms["left"].joints[-1]) + 1].rotation @ direction
    tilt = pin.Quaternion.FromTwoVectors(pointed, np.array([0.0, 0.0, -1.0])).matrix()
    low, high = (pin.SE3(tilt @ home.rotation, np.array([0.5, 0.25, height])) for height in (0.15, 0.3))
    cell.drive({"left": high}, 500)
    cell.drive({"left": low}, 900)
    pair = cell.set_opening(*narrow)
    assert pair is not None
    assert "table_0" in pair
    assert cell.controller.openings["left"] == wide
    assert cell.set_opening(0.3, 0.4) is None  # much less is within
    assert cell.spare_of_bodies(cell.controller.openings) >= -COAL
    assert cell.set_opening(*wide) is None
    cell.drive({"left": high}, 200)
    assert cell.set_opening(*narrow) is None


@pytest.mark.slow
def test_with_hostile_targets_and_openings_no_finger_is_ever_too_near_wherever_it_really_is(cell: Cell) -> None:
    random = np.random.default_rng(5)
    told = refused = 0
    for _ in range(6):
        cell.start()
        goals: dict[str, pin.SE3] = {}
        for tick in range(1000):
            if tick % 150 == 0:
                for arm, side in (("left", 1.0), ("right", -1.0)):
                    place = np.array([random.uniform(0.4, 0.6), side * random.uniform(-0.15, 0.2), 0.0])
                    place[2] = random.choice([0.1, 0.21, 0.23, 0.3])
                    tilt = pin.rpy.rpyToMatrix(np.pi + random.uniform(-0.6, 0.6), random.uniform(-0.3, 0.3), np.pi)
                    goals[arm] = pin.SE3(tilt, place)
            if random.random() < 0.2:
                arm = str(random.choice(["left", "right"]))
                low, high = np.sort(random.random(2)).tolist()
                least, greatest = ((low, high), (low, 1.0), (0.0, high), ALL_OF_THE_WAY)[random.integers(4)]
                told += 1
                refused += cell.set_opening(least, greatest, arm) is not None
            cell.drive(goals)
            if tick % 8 == 0:
                for choice in ((0, 0), (1, 1), (0, 1)):
                    openings = cell.controller.openings
                    at = {arm: openings[arm][end] for arm, end in zip(openings, choice, strict=True)}
                    assert cell.spare(at) >= -COAL
                at = {arm: float(random.uniform(*interval)) for arm, interval in cell.controller.openings.items()}
                assert cell.spare(at) >= -COAL
                assert cell.spare_of_bodies(cell.controller.openings) >= -COAL
    assert told > 500
    assert refused > 50
