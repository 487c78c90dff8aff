"""Which pairs of the shipped cells are monitored, and which links are monitored against a floor."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.robot.compose import compose
from q2r2_control.robot.pairs import CLEARANCE, link_of, pair_names
from q2r2_control.robot.robot import Robot
from tests.robot.conftest import one_arm
from tests.support.modules import load_script

FINGERS = "hand_e_finger_1_envelope"  # This is the body of both fingers, which lie on the same lines.
MOVING = [*(f"link_{index}" for index in range(1, 8)), "hand_e_envelope", FINGERS]


def _links(robot: Robot) -> set[frozenset[str]]:
    return {frozenset(map(link_of, names)) for names in pair_names(robot.collision_model)}


def test_every_moving_link_and_envelope_of_a_hand_is_monitored_against_the_other_arm_and_the_table(
    dual_iiwa: Robot,
) -> None:
    watched = _links(dual_iiwa)
    for one, other in (("left", "right"), ("right", "left")):
        for a in MOVING:
            for b in ["link_0", *MOVING]:
                assert frozenset((f"{one}_{a}", f"{other}_{b}")) in watched
            assert frozenset((f"{one}_{a}", "table")) in watched
    for fixed in ("table", "right_link_0"):
        assert frozenset(("left_link_0", fixed)) not in watched, "neither can move"
    hands = {link for pair in watched for link in pair if "hand_e" in link}
    assert hands == {f"{side}_{link}" for side in ("left", "right") for link in ("hand_e_envelope", FINGERS)}


@pytest.mark.parametrize("side", ["left", "right"])
def test_within_an_arm_exactly_the_pairs_of_links_that_can_meet_are_monitored(dual_iiwa: Robot, side: str) -> None:
    hand = "hand_e_envelope"
    near = [
        ("link_0", "link_2"), ("link_0", "link_3"), ("link_0", "link_4"), ("link_0", "link_5"), ("link_0", "link_6"),
        ("link_0", "link_7"), ("link_0", hand), ("link_1", "link_3"), ("link_1", "link_5"), ("link_1", "link_7"),
        ("link_1", hand), ("link_2", hand), ("link_3", "link_5"), ("link_5", hand), ("link_0", FINGERS),
        ("link_1", FINGERS), ("link_2", FINGERS),
    ]  # fmt: skip
    if dual_iiwa.name == "dual_iiwa14":
        near.append(("link_1", "link_6"))
    can_meet = {frozenset((f"{side}_{a}", f"{side}_{b}")) for a, b in near}
    assert {pair for pair in _links(dual_iiwa) if all(link.startswith(side) for link in pair)} == can_meet


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_floor_is_monitored_against_exactly_the_links_that_can_come_near_it(dual_iiwa: Robot, side: str) -> None:
    """Two links cannot come near the floor: link 1 turns only about the vertical, and link 2 is too short."""
    reach_it = {f"{side}_link_{index}" for index in range(3, 8)} | {f"{side}_hand_e_envelope", f"{side}_{FINGERS}"}
    with_floor = {link for pair in _links(dual_iiwa) if "floor" in pair for link in pair if link.startswith(side)}
    assert with_floor == reach_it


@pytest.mark.parametrize(
    ("rpy", "height"),
    [((0.0, 0.0, 0.7), 0.0), ((0.0, 0.5, 0.0), -0.3), ((0.0, 0.5, 0.0), 0.1), ((3.1416, 0.0, 0.0), -0.3)],
    ids=["upright", "tilted", "tilted, a floor that is high", "hung"],
)
def test_links_without_a_monitored_pair_with_the_floor_never_move_near_the_floor(
    rpy: tuple[float, ...], height: float
) -> None:
    mount = {"position": (0.0, 0.0, 0.0), "rpy": rpy}
    robot = Robot.from_config(one_arm(mount=mount).model_copy(update={"floor": height}))
    geometry = robot.collision_model.copy()
    floor = geometry.getGeometryId("floor_0")
    watched = {a for a, b in pair_names(geometry) if b == "floor_0"} | {b for a, b in pair_names(geometry)}
    free = [index for index, item in enumerate(geometry.geometryObjects) if item.name not in watched and index != floor]
    geometry.removeAllCollisionPairs()
    for index in free:
        geometry.addCollisionPair(pin.CollisionPair(index, floor))
    data, geometry_data, random = robot.model.createData(), geometry.createData(), np.random.default_rng(3)
    found = []
    for _ in range(300):
        q = random.uniform(robot.position_lower, robot.position_upper)
        pin.computeDistances(robot.model, data, geometry, geometry_data, q)
        found.append([result.min_distance for result in geometry_data.distanceResults])
    lowest, highest = np.min(found, axis=0), np.max(found, axis=0)
    assert ((lowest > CLEARANCE) | (highest - lowest < 1e-5)).all()


def test_a_link_named_floor_that_is_not_a_level_surface_is_treated_like_any_other_link() -> None:
    urdf = compose(one_arm().model_copy(update={"floor": None})).urdf.replace("left_link_5", "floor")
    robot = Robot.from_urdf(urdf, arms={"left": "left_link_ee"})
    assert frozenset(("left_link_1", "floor")) in _links(robot)


SAMPLES = 2000
model_srdfs = load_script("robots/make_srdf.py").model_srdfs
TOUCH, HAND = "media_flange_touch_pneumatic", {"model": "hand_e"}


def _disabled(text: str) -> set[tuple[str, ...]]:
    return {(element.tag, *element.attrib.values()) for element in ET.fromstring(text)}


@pytest.mark.parametrize("arm", ["iiwa7", "iiwa14"])
@pytest.mark.parametrize("flange", [None, pytest.param(TOUCH, marks=pytest.mark.slow)])
def test_every_shipped_srdf_lists_the_pairs_that_the_program_finds(arm: str, flange: str | None) -> None:
    gripper = (
        load_config(f"config/dual_{arm}.yaml").arms["left"].gripper.model_dump()
    )  # The gripper makes both fingers one body.
    made = model_srdfs(one_arm(model=arm, flange={"model": flange}, tool=HAND, gripper=gripper), SAMPLES)
    on = f"{TOUCH}_on_{arm}" if flange else arm
    assert made.keys() == {f"{arm}.srdf", "hand_e.srdf", f"{on}.srdf", f"hand_e_on_{on}.srdf"}
    for name, text in made.items():
        assert _disabled(text) == _disabled(find_resource(f"robots/{name}").read_text(encoding="utf-8"))
