"""Arms come close to the table, the floor, obstacles, each other and themselves, and always keep the contract."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot, load_config
from q2r2_control.benchmark.motion_run import JOLT, count_jolts
from q2r2_control.config.cell import Config
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import Array, Reference
from q2r2_control.wording import limit_name
from tests.control.cells import cell
from tests.control.scenarios import circle
from tests.support.driven import Driven

CONFIG = load_config("config/dual_iiwa7.yaml")
# The solver has no time limit, so that no result depends on the speed of the computer.
SETTINGS = CONFIG.control.model_copy(update={"solve_time_limit": None})
TABLE = 0.2  # Height of the table's top [m].
FRAME_TO_TIPS = 0.013  # Distance from the tool frame to the finger tips [m].
DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # The tools point down as at home.
SIDES = (("left", 1.0), ("right", -1.0))


@pytest.fixture(scope="module")
def controller() -> CartesianController:
    return CartesianController(Robot.from_config(CONFIG), SETTINGS)


def driven(controller: CartesianController, goal: Mapping[str, pin.SE3], seconds: float) -> Reference:
    """Drive from home to ``goal`` for a time in which the arms come to rest. Return the last reference."""
    run = Driven(controller, dt=0.004, random=np.random.default_rng(1))
    reference, contract = run.drive(seconds, goal), run.contract
    assert contract.tail_acceleration() < 0.1
    assert contract.fallback_share < 0.01
    assert contract.uncertified == 0
    return reference


def down_to(z: float, y: float = 0.25, x: float = 0.5) -> dict[str, pin.SE3]:
    """Return targets at the height ``z`` [m] at which both tools point down."""
    return {arm: pin.SE3(DOWN, np.array([x, side * y, z])) for arm, side in SIDES}


def heights(controller: CartesianController) -> list[float]:
    """Return the heights of both tools' tips [m]."""
    tips = np.array([0.0, 0.0, FRAME_TO_TIPS])
    return [float((controller.tool_pose(arm) * tips)[2]) for arm in controller.robot.arms]


def test_tools_driven_down_onto_the_table_end_with_their_tips_between_1_and_2_mm_above_it(
    controller: CartesianController,
) -> None:
    report = driven(controller, down_to(TABLE + FRAME_TO_TIPS - 0.3), 3.0).report
    assert all(0.001 < height - TABLE < 0.002 for height in heights(controller))
    assert 0.001 <= report.closest_distance < 0.0016
    assert "table_0" in report.closest_pair
    assert any("hand_e_finger" in name for name in report.closest_pair)


@pytest.mark.slow
def test_grippers_driven_towards_each_other_stop_at_the_kept_distance_of_their_fingers(
    controller: CartesianController,
) -> None:
    """The tools point at each other. At their targets, the finger tips would overlap by 50 mm."""
    goal = {
        arm: pin.SE3(
            pin.rpy.rpyToMatrix(side * np.pi / 2, 0.0, 0.0), np.array([0.55, side * (FRAME_TO_TIPS - 0.025), 0.5])
        )
        for arm, side in SIDES
    }
    report, least = driven(controller, goal, 6.0).report, SETTINGS.distances.finger_finger
    assert least is not None
    assert least <= report.closest_distance <= 1.6 * least
    assert all("finger" in name for name in report.closest_pair)


def test_the_nearest_pair_and_the_tightest_pair_are_reported_separately(controller: CartesianController) -> None:
    """Fingers 12 mm above the table have a larger margin than wrists 22 mm from each other."""
    reference = driven(controller, down_to(TABLE + FRAME_TO_TIPS + 0.012, y=0.0), 6.0)
    report, robot = reference.report, controller.robot
    assert "table_0" in report.closest_pair
    assert all("link_" in name for name in report.tightest_pair)
    margins = robot.distance_values(reference.q) - kept_distances(robot, SETTINGS).values
    assert report.margin == pytest.approx(margins.min(), abs=2e-6)
    assert report.margin < SETTINGS.distance_buffer + 1e-4


def test_bodies_whose_kept_distance_is_0_come_to_rest_without_touching() -> None:
    data = CONFIG.model_dump(mode="json")
    data["control"] |= {"pairs": [{"pair": ["*_finger_*", "table"], "distance": 0.0}], "solve_time_limit": None}
    config = CONFIG.model_validate(data)
    controller = CartesianController(Robot.from_config(config), config.control)
    assert 0.0 <= driven(controller, down_to(0.1), 3.0).report.closest_distance < 0.0005


Target = tuple[tuple[float, float, float], tuple[float, float, float]]

# For each arm, the position of the target [m], and the rotation vector from home to the target [rad].
SLIDES: dict[str, tuple[Target, Target]] = {
    "while a joint is at its limit": (
        ((0.294, 0.219, 0.473), (-0.609, -0.206, 0.149)),
        ((0.304, 0.259, 0.473), (0.322, 0.045, -0.311)),
    ),
    "nearest at the start of a stop or at its end": (
        ((0.469, -0.247, 0.276), (-0.079, -0.212, 0.297)),
        ((0.692, 0.218, 0.481), (0.286, 0.246, -0.527)),
    ),
}


@pytest.mark.parametrize("slide", SLIDES)
def test_joint_accelerations_hardly_jump_while_arms_slide_along_each_other(
    controller: CartesianController, slide: str
) -> None:
    dt, started = 0.001, 2000  # After ``started`` ticks the arms slide, and no longer react to the targets' jump.
    run = Driven(controller, dt=dt)
    targets = {
        arm: pin.SE3(pin.exp3(np.array(turn)) @ run.start[arm].rotation, np.array(place))
        for arm, (place, turn) in zip(run.start, SLIDES[slide], strict=True)
    }
    v = np.array([controller.step(targets, dt).v for _ in range(4000)])
    assert np.linalg.norm(v[started:], axis=1).min() > 0.05, "they slide all the time"
    # A jump is allowed in one of 100 ticks, for example when a pair begins to hold the arms back.
    assert count_jolts(v, dt, started * dt) <= 0.01 * 2000, f"changes of more than {JOLT:g} rad/s^2"


def with_floor(floor: float | None) -> CartesianController:
    return CartesianController(Robot.from_config(CONFIG.model_copy(update={"floor": floor})), SETTINGS)


def test_arms_with_targets_below_the_floor_beside_the_table_come_to_rest_above_the_floor() -> None:
    floor = -0.15
    controller = with_floor(floor)
    reference = driven(controller, down_to(-0.3, y=1.0, x=0.1), 4.0)
    assert "floor_0" in reference.report.closest_pair
    for height in heights(controller):
        assert floor < height < floor + 0.002, "down to where the floor stops it"


def hands_in_the_table(depth: float) -> Array:
    """Return a posture in which both grippers are inside the table, with the tools ``depth`` [m] below its top."""
    ghost = Robot.from_config(CONFIG)
    ghost.collision_model.removeAllCollisionPairs()
    controller = CartesianController(ghost, SETTINGS)
    targets = {arm: controller.tool_pose(arm) for arm in ghost.arms}
    for pose in targets.values():
        pose.translation = np.array([*pose.translation[:2], TABLE - depth])
    for _ in range(2000):
        reference = controller.step(targets, 0.002)
    return reference.q


def test_hands_and_wrists_that_start_deep_in_the_table_come_out_of_it() -> None:
    """Alone, a hand would leave the table through its underside near the floor, and a wrist through its top."""
    controller = with_floor(0.0)
    home = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    controller.reset(hands_in_the_table(0.18))
    reports = [controller.step(home, 0.002).report]
    while len(reports) < 500 and not reports[-1].certified:
        reports.append(controller.step(home, 0.002).report)
    assert reports[-1].certified
    assert np.diff([report.closest_distance for report in reports]).min() >= -1e-9, "it never comes closer"


def test_if_no_step_can_be_certified_the_report_names_the_pairs_that_are_too_close() -> None:
    """Without a floor, a hand would leave the table downwards and a wrist upwards, so neither can move."""
    controller = with_floor(None)
    home = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    controller.reset(hands_in_the_table(0.12))
    for _ in range(50):
        report = controller.step(home, 0.002).report
    assert report.fallback
    assert not report.certified
    too_close = {"left_hand_e_envelope_0|table_0", "left_link_7_0|table_0", "right_hand_e_envelope_0|table_0"}
    assert too_close <= set(map(limit_name, report.binding))


SHAPES = {"box": [0.1, 0.1, 0.5], "cylinder": [0.06, 0.5]}


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_a_tool_whose_target_is_inside_an_obstacle_comes_to_rest_in_front_of_the_obstacle(shape: str) -> None:
    post = {"shape": shape, "size": SHAPES[shape], "position": [0.65, 0.1, 0.55], "rpy": [0.3, 0.2, 0.0]}
    data = CONFIG.model_dump(mode="json")
    data["obstacles"]["post"] = post
    robot = Robot.from_config(Config.model_validate(data))
    goal = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    goal["left"].translation = np.array([0.65, 0.1, 0.5])
    reference = driven(CartesianController(robot), goal, 4.0)
    assert "post" in "|".join(reference.report.closest_pair)
    # Coal measures the shapes of the cell. They lie inside the monitored bodies, so their distance is not smaller.
    assert min(pair.distance for pair in robot.distances(reference.q)) >= 0.02 - 1e-5
    assert reference.report.closest_distance < 0.03, "it goes as near as it may"


def test_a_target_that_bends_the_hand_towards_the_forearm_is_followed_up_to_the_kept_distance(
    controller: CartesianController,
) -> None:
    inwards = pin.SE3(pin.rpy.rpyToMatrix(0.0, 1.2, 0.0), np.zeros(3))
    run = Driven(controller)
    reference = run.drive(4.0, {"left": run.start["left"] * inwards})
    nearest = controller.robot.distance_values(reference.q).min()
    assert SETTINGS.min_distance <= nearest < SETTINGS.min_distance + 0.01
    assert reference.report.closest_pair == ("left_link_5_0", "left_hand_e_envelope_0")


@pytest.mark.slow
def test_a_circle_is_followed_well_although_the_hand_is_near_the_forearm_of_its_own_arm(
    controller: CartesianController,
) -> None:
    """The circle is half a metre in the air. The target moves at 0.3 m/s. At the top, 6 mm are free."""
    run, errors, nearest = Driven(controller, dt=0.001), [], np.inf
    for tick in range(4000):
        nearest = min(nearest, run.drive(0.001, circle).report.closest_distance)
        goal = circle(0.001 * tick, run.start)["left"]
        assert goal is not None
        errors.append(np.linalg.norm(controller.tool_pose("left").translation - goal.translation))
    assert nearest < SETTINGS.min_distance + 0.01
    assert np.sqrt(np.mean(np.square(errors[1000:]))) < 0.004


def test_the_spare_distance_of_an_arm_is_the_least_margin_of_its_pairs_with_other_bodies() -> None:
    """The names of links begin with the name of their arm. The table and the floor belong to no arm."""
    robot, random, kept = cell("dual_iiwa7").robot, np.random.default_rng(5), 0.03
    controller = CartesianController(robot, ControllerSettings(min_distance=kept))
    for _ in range(60):
        q = robot.home + random.normal(0.0, 0.4, len(robot.home))
        controller.reset(q)
        for arm in robot.arms:
            pairs = [pair for pair in robot.distances(q) if pair.name_a.startswith(arm) != pair.name_b.startswith(arm)]
            least = min(pair.distance for pair in pairs)
            assert controller.spare_distance(arm) == pytest.approx(least - kept, abs=1e-6)
