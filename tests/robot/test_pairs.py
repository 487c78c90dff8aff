"""Which pairs are monitored in the shipped cell and in a cell of two pandas."""

from __future__ import annotations

import coal
import pytest

from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot

MOVING = [*(f"link_{index}" for index in range(1, 8)), "hand_e_envelope"]


def _links(robot: Robot) -> set[frozenset[str]]:
    return {frozenset(map(link_of, names)) for names in pair_names(robot.collision_model)}


def test_every_moving_link_is_watched_against_every_link_of_the_other_arm_and_its_base(dual_iiwa: Robot) -> None:
    watched = _links(dual_iiwa)
    for one, other in (("left", "right"), ("right", "left")):
        for a in MOVING:
            for b in ["link_0", *MOVING]:
                assert frozenset((f"{one}_{a}", f"{other}_{b}")) in watched


def test_every_moving_link_is_watched_against_the_table(dual_iiwa: Robot) -> None:
    for side in ("left", "right"):
        for link in MOVING:
            assert frozenset((f"{side}_{link}", "table")) in _links(dual_iiwa)


@pytest.mark.parametrize("side", ["left", "right"])
def test_own_links_that_can_meet_are_watched_and_no_others(dual_iiwa: Robot, side: str) -> None:
    hand = "hand_e_envelope"
    can_meet = {
        frozenset((f"{side}_{a}", f"{side}_{b}"))
        for a, b in [
            ("link_0", "link_4"), ("link_0", "link_5"), ("link_0", "link_6"), ("link_0", "link_7"), ("link_0", hand),
            ("link_1", "link_7"), ("link_1", hand), ("link_2", hand),
        ]
    }  # fmt: skip
    assert {pair for pair in _links(dual_iiwa) if all(link.startswith(side) for link in pair)} == can_meet


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("left_link_0", "right_link_0"),
        ("left_link_0", "table"),
        ("left_link_1", "left_link_0"),
        ("left_link_7", "left_hand_e_envelope"),
        ("left_link_6", "left_hand_e_envelope"),
    ],
)
def test_pairs_that_cannot_move_or_are_neighbours_are_not_watched(dual_iiwa: Robot, a: str, b: str) -> None:
    assert frozenset((a, b)) not in _links(dual_iiwa)


def test_neither_fingers_nor_the_bare_hand_are_watched_because_the_envelope_is(dual_iiwa: Robot) -> None:
    links = {link for pair in _links(dual_iiwa) for link in pair}
    assert not {link for link in links if "finger" in link or link.endswith("hand_e_base")}


@pytest.mark.parametrize("cell", ["dual_iiwa7", "dual_panda"])
def test_every_watched_shape_has_a_kernel(cell: str, request: pytest.FixtureRequest) -> None:
    robot: Robot = request.getfixturevalue(cell)
    objects = robot.collision_model.geometryObjects
    for pair in robot.collision_model.collisionPairs:
        shapes = [objects[pair.first], objects[pair.second]]
        assert sum(isinstance(item.geometry, coal.Box) for item in shapes) <= 1
        for item in shapes:
            assert isinstance(item.geometry, coal.Capsule | coal.Sphere) or item.parentJoint == 0


def test_two_pandas_watch_each_other_their_table_and_themselves(dual_panda: Robot) -> None:
    watched = _links(dual_panda)
    for expected in (
        ("left_panda_link4", "right_panda_link4"),
        ("left_panda_hand", "right_panda_link0"),
        ("left_panda_leftfinger", "right_panda_rightfinger"),
        ("left_panda_hand", "table"),
        ("left_panda_link0", "left_panda_hand"),
    ):
        assert frozenset(expected) in watched
    for listed in (("left_panda_link3", "left_panda_link5"), ("left_panda_hand", "left_panda_link7")):
        assert frozenset(listed) not in watched


@pytest.mark.parametrize("cell", ["dual_iiwa7", "dual_panda"])
def test_nothing_overlaps_at_home_and_nothing_had_to_be_ignored(cell: str, request: pytest.FixtureRequest) -> None:
    robot: Robot = request.getfixturevalue(cell)
    assert robot.ignored_pairs == ()
    assert min(pair.distance for pair in robot.distances(robot.home)) > 0.02
