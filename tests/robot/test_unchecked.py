"""An arm is refused if some of its links would keep no distance, unless ``unchecked_links`` names these links."""

from __future__ import annotations

import re

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import RobotError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.pipeline.slow_run import SlowRun
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.robot.description import load_description
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.unchecked import check_watched, unchecked_faults, unchecked_notes
from q2r2_control.supervision.preflight import preflight_faults
from tests.robot.conftest import one_arm

BALL = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
DRAWN = '<visual><geometry><box size="0.02 0.02 0.3"/></geometry></visual>'


def weighs(mass: float) -> str:
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    return f'<inertial><mass value="{mass}"/>{inertia}</inertial>'


def chain(*contents: str) -> str:
    """Return a chain of links l1, l2 and so on, with the given contents, on a base l0.

    The links are 0.3 m apart, and turn on each other. The last link is fixed to the link before it.
    """
    joints = "".join(
        f'<joint name="j{n}" type="{"fixed" if n == len(contents) else "revolute"}"><parent link="l{n - 1}"/>'
        f'<child link="l{n}"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        for n in range(1, len(contents) + 1)
    )
    links = "".join(f'<link name="l{n}">{content}</link>' for n, content in enumerate(contents, start=1))
    return f'<robot name="chain"><link name="l0"/>{links}{joints}</robot>'


def arm(third: str = BALL, last: str = BALL) -> str:
    """Return a chain of five links, by default balls. The third and the last link may have other contents."""
    return chain(BALL, BALL, third, BALL, last)


@pytest.mark.parametrize(
    ("urdf", "fault"),
    [
        pytest.param(
            arm(weighs(0.5)), "l3: weighs 0.5 kg and has no collision shape", id="between links that have one"
        ),
        pytest.param(arm(last=weighs(0.03) + DRAWN), "l5: weighs 0.03 kg and has no", id="fixed to one that has one"),
        pytest.param(arm(DRAWN), "l3: is drawn and has no collision shape", id="drawn, of a mass that is not said"),
    ],
)
def test_a_heavy_or_visible_link_without_a_collision_shape_is_refused_unless_unchecked_links_names_it(
    urdf: str, fault: str
) -> None:
    with pytest.raises(RobotError, match=re.escape(fault)) as error:
        Robot.from_urdf(urdf, {"left": "l5"})
    link = fault[:2]
    assert str(error.value).endswith(f"allowed: <collision> in its model, or unchecked_links=['{link}']")
    assert Robot.from_urdf(urdf, {"left": "l5"}, unchecked_links=[link]).unchecked_links == (link,)


@pytest.mark.parametrize(
    "frame", ["", weighs(0.01), weighs(0.0001) + DRAWN], ids=["neither", "10 g", "drawn, and said to be light"]
)
def test_a_link_that_is_only_a_frame_needs_no_collision_shape(frame: str) -> None:
    assert Robot.from_urdf(arm(last=frame), {"left": "l5"}).unchecked_links == ()


def test_one_error_names_all_links_without_a_collision_shape() -> None:
    with pytest.raises(RobotError, match=r"l3: weighs 1 kg.*; l5: weighs 2 kg"):
        Robot.from_urdf(arm(weighs(1.0), weighs(2.0)), {"left": "l5"})


def test_a_link_that_no_arm_moves_needs_no_shape() -> None:
    base = arm().replace('<link name="l0"/>', f'<link name="l0">{weighs(20.0)}</link>')
    assert Robot.from_urdf(base, {"left": "l5"}).unchecked_links == ()


def test_unchecked_notes_name_a_visible_base_without_a_collision_shape_until_the_user_decides() -> None:
    urdf = arm().replace('<link name="l0"/>', f'<link name="l0">{weighs(0.0001)}{DRAWN}</link>')
    robot = Robot.from_urdf(urdf, {"left": "l5"})
    assert unchecked_faults(robot) == []
    (note,) = unchecked_notes(robot)
    assert "nothing keeps the arms off links that stand still and are drawn without a collision shape: l0; " in note
    assert "capsules: {l0: 1} around the drawings, or unchecked_links" in note
    named = Robot.from_urdf(urdf, {"left": "l5"}, unchecked_links=["l0"])
    assert list(unchecked_notes(named)) == ["unchecked_links: nothing keeps l0 off anything"]


def test_a_base_that_is_named_but_has_a_shape_is_still_monitored_and_unchecked_notes_say_so() -> None:
    urdf = arm().replace('<link name="l0"/>', f'<link name="l0">{BALL}</link>')
    robot = Robot.from_urdf(urdf, {"left": "l5"}, unchecked_links=["l0"])
    assert list(unchecked_notes(robot)) == [
        "unchecked_links: watched all the same, since they have collision shapes: l0"
    ]


def test_an_arm_without_monitored_pairs_is_refused_unless_unchecked_links_names_its_tool() -> None:
    neighbours = chain(BALL, BALL, "")
    with pytest.raises(RobotError, match=r"left arm: no pair of its shapes is monitored.* or unchecked_links=\['l3'\]"):
        Robot.from_urdf(neighbours, {"left": "l3"})
    assert Robot.from_urdf(neighbours, {"left": "l3"}, unchecked_links=("l3",)).collision_model.ngeoms == 2


def test_an_arm_without_shapes_is_refused_even_if_another_arm_has_shapes() -> None:
    other = (
        arm().replace('<robot name="chain">', "").replace("</robot>", "").replace('"l', '"a_l').replace('"j', '"a_j')
    )
    bare = chain(*[weighs(1.0)] * 4).replace("</robot>", "")
    joint = '<joint name="beside" type="fixed"><parent link="l0"/><child link="a_l0"/></joint>'
    with pytest.raises(
        RobotError, match=r"left arm: no link between its base and its tool .*'l1', 'l2', 'l3', 'l4'"
    ) as e:
        Robot.from_urdf(f"{bare}{other}{joint}</robot>", {"left": "l4", "right": "a_l5"})
    assert "right arm" not in str(e.value)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        (["l9"], "unchecked_links: no link 'l9'; links: l0, l1"),
        ("l3", "unchecked_links = 'l3': allowed: names of links"),
    ],
)
def test_names_of_missing_links_in_unchecked_links_are_refused(given: object, complaint: str) -> None:
    with pytest.raises(RobotError, match=re.escape(complaint)):
        Robot.from_urdf(arm(), {"left": "l5"}, unchecked_links=given)  # type: ignore[arg-type]


def z1(**keys: object) -> Config:
    """Return a cell of Unitree's Z1, in whose model two heavy links have visual geometry and no collision shape."""
    model = str(load_description("example-robot-data:z1").file)
    made = one_arm(model=model, tip="gripperStator", home=[0.0, 1.0, -0.5, 0.0, 0.0, 0.0])
    return Config.model_validate(made.model_dump() | keys)


def test_a_cell_can_name_links_without_collision_shapes_or_enclose_their_visual_geometry() -> None:
    assert [fault.partition(":")[0] for fault in unchecked_faults(Robot.from_config(z1()))] == [
        "left_link01",
        "left_link05",
    ]
    assert (
        "capsules: {left_link05: 1} around its drawing"
        in preflight_faults(Robot.from_config(z1()), ControllerSettings(), None)[1]
    )
    robot = Robot.from_config(z1(capsules={"left_link05": 1}, unchecked_links=["left_link01"]))
    assert unchecked_faults(robot) == []
    assert list(unchecked_notes(robot)) == ["unchecked_links: nothing keeps left_link01 off anything"]
    check_watched(robot, "cell")
    watched = {link_of(name) for pair in pair_names(robot.collision_model) for name in pair}
    assert "left_link05" in watched
    assert "left_link01" not in watched


def test_programs_that_move_arms_refuse_links_without_shapes_with_the_faults_of_unchecked_faults() -> None:
    lines = "; ".join(unchecked_faults(Robot.from_config(z1())))
    with pytest.raises(RobotError, match=re.escape(f"{z1().name}: {lines}")):
        Pipeline.from_config(z1(), input="scripted", plant="kinematic")
    with pytest.raises(RobotError, match=re.escape(lines)):
        SlowRun(z1(), KinematicPlant)


def test_a_link_that_is_named_but_has_a_shape_is_still_monitored_and_unchecked_notes_say_so() -> None:
    robot = Robot.from_urdf(arm(), {"left": "l5"}, unchecked_links=["l3"])
    assert list(unchecked_notes(robot)) == [
        "unchecked_links: watched all the same, since they have collision shapes: l3"
    ]
