"""A pair keeps the distance for its names, otherwise the distance for its class of bodies, otherwise min_distance."""

from __future__ import annotations

from typing import Any

import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import Robot
from tests.robot.conftest import one_arm

# Each class has a different distance.
BY_CLASS = {
    name: 0.001 * (index + 1)
    for index, name in enumerate(
        (
            *("arm_arm", "arm_self", "arm_obstacle", "tool_arm", "tool_tool"),
            *("tool_obstacle", "finger_arm", "finger_tool", "finger_finger", "finger_obstacle"),
        )
    )
}


def kept(robot: Robot, **settings: Any) -> dict[frozenset[str], float]:
    """Return the kept distance of each pair of links [m]."""
    found = kept_distances(robot, ControllerSettings.model_validate(settings))
    pairs = robot.distances(robot.home)
    return {
        frozenset((link_of(pair.name_a), link_of(pair.name_b))): float(value)
        for pair, value in zip(pairs, found.values, strict=True)
    }


@pytest.mark.parametrize(
    ("a", "b", "name"),
    [
        ("left_link_4", "right_link_5", "arm_arm"),
        ("left_link_4", "right_link_0", "arm_arm"),
        ("left_link_3", "left_link_5", "arm_self"),
        ("left_link_5", "left_hand_e_envelope", "arm_self"),
        ("left_link_2", "left_hand_e_finger_1_envelope", "arm_self"),
        ("right_link_6", "table", "arm_obstacle"),
        ("right_link_6", "floor", "arm_obstacle"),
        ("left_hand_e_envelope", "right_link_6", "tool_arm"),
        ("left_hand_e_envelope", "right_hand_e_envelope", "tool_tool"),
        ("right_hand_e_envelope", "table", "tool_obstacle"),
        ("right_hand_e_finger_1_envelope", "left_link_0", "finger_arm"),
        ("right_hand_e_finger_1_envelope", "left_hand_e_envelope", "finger_tool"),
        ("left_hand_e_finger_1_envelope", "right_hand_e_finger_1_envelope", "finger_finger"),
        ("left_hand_e_finger_1_envelope", "floor", "finger_obstacle"),
    ],
)
def test_a_pair_keeps_the_distance_of_its_class(dual_iiwa: Robot, a: str, b: str, name: str) -> None:
    assert kept(dual_iiwa, distances=BY_CLASS)[frozenset((a, b))] == BY_CLASS[name]
    alone = kept(dual_iiwa, distances={name: 0.0})
    assert alone[frozenset((a, b))] == 0.0, "zero is a distance, and none is not"
    assert 0.02 in alone.values()


def test_a_hand_in_the_model_of_its_arm_is_a_tool_and_the_links_that_its_gripper_moves_are_fingers() -> None:
    gripper = {"joints": ["panda_finger_joint1"], "open_position": 0.04, "closed_position": 0.0}
    home = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
    config = one_arm(model="example-robot-data:panda", home=home, gripper=gripper)
    table = {"shape": "box", "size": [0.1, 0.1, 0.1], "position": [0.9, 0.0, 0.1]}
    robot = Robot.from_config(config.model_validate(config.model_dump() | {"obstacles": {"table": table}}))
    found = kept(robot, distances=BY_CLASS)
    assert found[frozenset(("left_panda_hand", "table"))] == BY_CLASS["tool_obstacle"]
    assert found[frozenset(("left_panda_link6", "table"))] == BY_CLASS["arm_obstacle"]
    for finger in ("leftfinger", "rightfinger"):  # The second finger mimics the first.
        if frozenset((f"left_panda_{finger}", "table")) in found:
            assert found[frozenset((f"left_panda_{finger}", "table"))] == BY_CLASS["finger_obstacle"]
    assert frozenset(("left_panda_leftfinger", "table")) in found


def test_a_named_pair_keeps_its_own_distance_instead_of_the_distance_of_its_class(dual_iiwa: Robot) -> None:
    named = [
        {"pair": ["table", "left_*"], "distance": 0.05},
        {"pair": ["left_link_?", "table"], "distance": 0.06},
        {"pair": ["right_link_5_0", "left_link_5_0"], "distance": 0.07},
    ]
    found = kept(dual_iiwa, distances=BY_CLASS, pairs=named)
    assert found[frozenset(("left_hand_e_envelope", "table"))] == 0.05
    assert found[frozenset(("left_link_6", "table"))] == 0.06, "the last one that fits"
    assert found[frozenset(("left_link_5", "right_link_5"))] == 0.07, "bodies by the names that reports have"
    assert found[frozenset(("right_link_6", "table"))] == BY_CLASS["arm_obstacle"]
    assert found[frozenset(("left_link_5", "right_link_6"))] == BY_CLASS["arm_arm"]


@pytest.mark.parametrize(
    ("pair", "says"),
    [
        (["tabel", "left_*"], r"no monitored body is called 'tabel'; allowed: names of links, \* and \?: floor, left_"),
        (["left_link_1", "left_link_2"], "these are no monitored pair: neighbours"),
        (["table", "floor"], "these are no monitored pair"),
        (["left_LINK_5", "table"], "no monitored body is called 'left_LINK_5'"),
    ],
)
def test_names_that_no_pair_has_raise_an_error_of_one_line(dual_iiwa: Robot, pair: list[str], says: str) -> None:
    settings = ControllerSettings.model_validate({"pairs": [{"pair": pair, "distance": 0.01}]})
    with pytest.raises(ConfigError, match=rf"^control\.pairs\[0\]\.pair = .*: {says}") as caught:
        kept_distances(dual_iiwa, settings)
    assert len(str(caught.value).splitlines()) == 1


def test_the_property_largest_distance_names_the_setting_with_the_greatest_distance() -> None:
    for settings, key in (
        ({}, "min_distance"),
        ({"distances": {"arm_self": 0.03}}, "distances.arm_self"),
        ({"distances": {"arm_self": 0.03}, "pairs": [{"pair": ["a", "b"], "distance": 0.04}]}, "pairs[0].distance"),
    ):
        assert ControllerSettings.model_validate(settings).largest_distance[0] == key
