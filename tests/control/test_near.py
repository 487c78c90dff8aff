"""How near the tools of the shipped cell come: fingers to the table, hand to hand, the contract kept at every tick."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.benchmark.motion_run import JOLT, count_jolts
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import Array, Reference
from q2r2_control.verification.contract import Contract
from tests.support.driven import Driven

CONFIG = load_config("config/dual_iiwa7.yaml")
SETTINGS = CONFIG.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock
TABLE = 0.2  # height of its top [m]
FRAME_TO_TIPS = 0.013  # [m]
DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # as at home


@pytest.fixture(scope="module")
def controller() -> CartesianController:
    return CartesianController(Robot.from_config(CONFIG), SETTINGS)


def driven(controller: CartesianController, goal: Mapping[str, pin.SE3], seconds: float) -> Reference:
    """From home towards ``goal``, to rest."""
    run = Driven(controller, random=np.random.default_rng(1))
    reference, contract = run.drive(seconds, goal), run.contract
    assert contract.tail_acceleration() < 0.1
    assert contract.fallbacks == contract.uncertified == 0
    return reference


def tips_above_the_table(controller: CartesianController) -> list[float]:
    tips = pin.SE3(np.eye(3), np.array([0.0, 0.0, FRAME_TO_TIPS]))
    return [float((controller.tool_pose(arm) * tips).translation[2]) - TABLE for arm in controller.robot.arms]


@pytest.mark.parametrize("depth", [0.02, 0.3])
def test_tools_driven_down_onto_the_table_end_with_their_tips_between_1_and_2_mm_above_it(
    controller: CartesianController, depth: float
) -> None:
    goal = {
        arm: pin.SE3(DOWN, np.array([0.5, y, TABLE + FRAME_TO_TIPS - depth]))
        for arm, y in (("left", 0.25), ("right", -0.25))
    }
    reference = driven(controller, goal, 3.0)
    assert all(0.001 < height < 0.002 for height in tips_above_the_table(controller))
    assert 0.001 <= reference.report.closest_distance < 0.0016
    assert {name.split("_envelope")[0] for name in reference.report.closest_pair} <= {
        *(f"{arm}_hand_e_finger_1" for arm in controller.robot.arms),
        "table_0",
    }


def test_a_tool_goes_to_where_it_holds_a_block_flat_on_the_table(controller: CartesianController) -> None:
    """Half a centimetre above it, straight: nothing pushes it aside."""
    pose = pin.SE3(DOWN, np.array([0.5, 0.25, TABLE + FRAME_TO_TIPS + 0.005]))
    driven(controller, {"left": pose}, 3.0)
    np.testing.assert_allclose(controller.tool_pose("left").homogeneous, pose.homogeneous, atol=1e-3)


def facing(gap: float) -> dict[str, pin.SE3]:
    """Tools that point at each other, their tips a ``gap`` [m] apart."""
    return {
        arm: pin.SE3(pin.rpy.rpyToMatrix(side * np.pi / 2, 0.0, 0.0), np.array([0.55, side * y, 0.5]))
        for arm, side in (("left", 1.0), ("right", -1.0))
        for y in [0.5 * gap + FRAME_TO_TIPS]
    }


def test_hands_driven_at_each_other_end_at_the_distance_that_fingers_keep(controller: CartesianController) -> None:
    reference = driven(controller, facing(-0.05), 6.0)
    least = SETTINGS.distances.finger_finger
    assert least is not None
    assert least <= reference.report.closest_distance <= 1.6 * least
    assert all("finger" in name for name in reference.report.closest_pair)


def test_the_nearest_pair_and_the_tightest_one_are_told_apart(controller: CartesianController) -> None:
    """Fingers 12 mm above the table have more to spare than wrists 22 mm from each other."""
    height = TABLE + FRAME_TO_TIPS + 0.012
    goal = {arm: pin.SE3(DOWN, np.array([0.5, 0.0, height])) for arm in controller.robot.arms}
    reference = driven(controller, goal, 6.0)
    report, robot = reference.report, controller.robot
    assert "table_0" in report.closest_pair
    assert all("link_" in name for name in report.tightest_pair)
    margins = robot.distance_values(reference.q) - kept_distances(robot, SETTINGS).values
    assert report.margin == pytest.approx(margins.min(), abs=2e-6)
    assert report.margin < SETTINGS.distance_buffer + 1e-4


def test_pairs_that_may_touch_come_to_rest_apart() -> None:
    named = {"pair": ["*_finger_*", "table"], "distance": 0.0}
    data = CONFIG.model_dump(mode="json")
    data["control"] |= {"pairs": [named], "solve_time_limit": None}
    config = CONFIG.model_validate(data)
    controller = CartesianController(Robot.from_config(config), config.control)
    goal = {arm: pin.SE3(DOWN, np.array([0.5, y, 0.1])) for arm, y in (("left", 0.25), ("right", -0.25))}
    reference = driven(controller, goal, 3.0)
    assert 0.0 <= reference.report.closest_distance < 0.0005


DT = 0.001  # [s]
TICKS = 4000
STARTED = 2.0  # the slide has begun, and the targets' jump is over [s]
FEW = 0.01  # of the ticks: a new pair that comes to hold the arms may still make a jolt

Target = tuple[tuple[float, float, float], tuple[float, float, float]]

# Where each tool is asked to be [m], and how far it is turned from home about which axis [rad].
SLIDES: dict[str, tuple[Target, Target]] = {
    "while a joint is at its limit": (
        ((0.294, 0.219, 0.473), (-0.609, -0.206, 0.149)),
        ((0.304, 0.259, 0.473), (0.322, 0.045, -0.311)),
    ),
    "nearest at the start of a stop or at its end": (
        ((0.469, -0.247, 0.276), (-0.079, -0.212, 0.297)),
        ((0.692, 0.218, 0.481), (0.286, 0.246, -0.527)),
    ),
    "opening and closing in turns": (
        ((0.636, -0.095, 0.429), (0.569, 0.232, -0.051)),
        ((0.52, 0.16, 0.625), (0.088, 0.338, -0.022)),
    ),
    "along a way that is hardly bent": (
        ((0.596, -0.232, 0.439), (-0.009, -0.584, -0.269)),
        ((0.454, 0.15, 0.336), (0.538, 0.283, -0.147)),
    ),
}


@pytest.mark.parametrize("slide", SLIDES)
def test_joints_hardly_jolt_while_arms_slide_along_each_other(slide: str) -> None:
    config = load_config("config/dual_iiwa7.yaml")
    settings = config.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock
    controller = CartesianController(Robot.from_config(config), settings)
    contract = Contract(controller, controller.robot.home)
    home = {arm: controller.tool_pose(arm) for arm in ("left", "right")}
    targets = {
        arm: pin.SE3(pin.exp3(np.array(turn)) @ home[arm].rotation, np.array(place))
        for arm, (place, turn) in zip(home, SLIDES[slide], strict=True)
    }
    v: list[Array] = []
    for _ in range(TICKS):
        reference = controller.step(targets, DT)
        contract.check(reference, DT)
        v.append(reference.v)
    moving = np.linalg.norm(v[round(STARTED / DT) :], axis=1)
    assert moving.min() > 0.05, "they slide all the time"
    assert count_jolts(np.array(v), DT, STARTED) <= FEW * (TICKS - STARTED / DT), (
        f"changes of more than {JOLT:g} rad/s^2"
    )
