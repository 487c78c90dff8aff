"""Pairs that may touch enter each other no deeper and no faster than allowed. Other pairs keep their distances."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import check_settings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.pairs import pair_names
from q2r2_control.types import Array
from tests.support.driven import Driven

CONFIG = load_config("config/dual_iiwa7.yaml")
ROBOT = Robot.from_config(CONFIG)
PAIRS = pair_names(ROBOT.collision_model)
TABLE = 0.2  # Height of the table's top [m].
FRAME_TO_TIPS = 0.013  # Distance from the tool frame to the finger tips [m].
DEPTH, SPEED = 0.012, 0.04  # Allowed depth [m] and closing speed [m/s] of a contact.
DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # The tools point down as at home.
DT = 0.002


def settings(*allowed: dict[str, Any]) -> ControllerSettings:
    values = CONFIG.control.model_dump() | {"contact_allowed": allowed, "solve_time_limit": None}
    return ControllerSettings.model_validate(values)


def towards_the_table(controller: CartesianController, speed: float, seconds: float = 4.0) -> tuple[Array, Array]:
    """Move the left target downwards at ``speed`` [m/s], until it is 0.3 m inside the table.

    Return the distance of the left fingers from the table [m] and their closing speed [m/s], both at every tick.
    """
    pairs = np.array([set(pair) > {"table_0"} and "left_hand_e_finger" in str(pair) for pair in PAIRS])
    run, heights = Driven(controller, dt=DT), []
    for i in range(round(seconds / DT)):
        z = max(0.40 - speed * i * DT, TABLE - 0.3)
        reference = run.drive(DT, {"left": pin.SE3(DOWN, np.array([0.5, 0.25, z]))})
        heights.append(float(ROBOT.distance_values(reference.q)[pairs].min()))
    assert run.contract.fallbacks == run.contract.uncertified == 0
    assert run.contract.tail_acceleration() < 0.1
    return np.array(heights), -np.diff(heights, prepend=heights[0]) / DT


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.2, 5.0])
def test_a_finger_that_may_touch_the_table_enters_it_no_deeper_and_no_faster_than_allowed(speed: float) -> None:
    allowed = settings({"pair": ["left_*finger*", "table"], "depth": DEPTH, "speed": SPEED})
    heights, speeds = towards_the_table(CartesianController(ROBOT, allowed), speed)
    assert heights.min() == pytest.approx(-DEPTH, abs=5e-4)
    assert heights.min() >= -DEPTH
    assert speeds[heights < 0.001].max() <= 1.05 * SPEED
    assert speeds[heights > 0.05].max() > 2.0 * SPEED, "nothing is slowed that is far from contact"


def test_a_body_that_must_not_touch_the_table_keeps_its_distance_while_another_body_touches_it() -> None:
    """The right fingers have targets at the same height, but are not allowed to touch the table."""
    controller = CartesianController(ROBOT, settings({"pair": ["left_*finger*", "table"], "depth": DEPTH}))
    goal = {arm: pin.SE3(DOWN, np.array([0.5, y, 0.1])) for arm, y in (("left", 0.25), ("right", -0.25))}
    Driven(controller, dt=DT).drive(3.0, goal)
    tips = {arm: float((controller.tool_pose(arm) * np.array([0.0, 0.0, FRAME_TO_TIPS]))[2]) - TABLE for arm in goal}
    assert tips["left"] < -0.01
    assert 0.001 < tips["right"] < 0.002


@pytest.mark.slow
def test_fingers_of_both_hands_can_touch_each_other_if_the_settings_allow_it() -> None:
    """The hands face each other, and their targets cross over. The fingers enter each other up to the allowed depth."""
    depth = 0.005
    controller = CartesianController(ROBOT, settings({"pair": ["*finger*", "*finger*"], "depth": depth}))

    def across(t: float, start: Mapping[str, pin.SE3]) -> dict[str, pin.SE3]:
        """Return targets that are turned about x so that the tools point at each other, and that come closer."""
        gap = max(0.25 - 0.1 * t, -0.01)
        return {
            arm: pin.SE3(pin.rpy.rpyToMatrix(-sign, 0.0, 0.0) @ DOWN, np.array([0.5, sign * gap, 0.45]))
            for arm, sign in (("left", 1.0), ("right", -1.0))
        }

    reference = Driven(controller, dt=DT).drive(8.0, across)
    names = [pair for pair in ROBOT.distances(reference.q) if pair.distance < 0.0]
    assert names, "they touch"
    assert all("left_hand_e_finger" in pair.name_a and "right_hand_e_finger" in pair.name_b for pair in names)
    assert -depth <= min(pair.distance for pair in names) < -depth + 1e-3


@pytest.mark.parametrize("look", [CartesianController, check_settings])
@pytest.mark.parametrize(
    ("allowed", "says"),
    [
        (
            {"pair": ["*finger*", "tabel"]},
            r"control\.contact_allowed\[0\]\.pair = .*no monitored body is called 'tabel'",
        ),
        (
            {"pair": ["left_*finger*", "right_*finger*"], "depth": 0.02},
            r"control\.contact_allowed\[0\]\.depth = 0\.02: allowed for left_hand_e_finger.*: up to 0\.0155 m",
        ),
    ],
)
def test_unknown_names_and_too_large_depths_of_allowed_contacts_are_refused(
    look: Callable[[Robot, ControllerSettings], object], allowed: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        look(ROBOT, settings(allowed))
