"""Flanges between an arm and its tool: the pose of the tool, the monitored pairs, and refused flanges."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import load_description
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from tests.robot.conftest import one_arm

TOUCH = {"model": "media_flange_touch_pneumatic"}
CYLINDER = {"thickness": 0.03, "radius": 0.05, "mass": 0.4}
HAND = {"model": "hand_e", "frame": "tool_frame"}
POSTURE = np.array([0.3, 0.5, -0.2, -1.3, 0.4, 1.1, -0.6])


def with_flange(flange: dict[str, Any], cell: str = "dual_iiwa7") -> Config:
    """Return a shipped cell whose arms both have a flange."""
    data = load_config(f"config/{cell}.yaml").model_dump()
    for arm in data["arms"].values():
        arm["flange"] = flange
    return Config.model_validate(data)


def watched(robot: Robot) -> set[frozenset[str]]:
    return {frozenset(map(link_of, pair)) for pair in pair_names(robot.collision_model)}


@pytest.mark.parametrize(
    ("flange", "thickness", "mass"),
    [(TOUCH, 0.026, 0.13), (CYLINDER, 0.03, 0.4), (CYLINDER | {"mass": 0.0}, 0.03, 0.0)],
    ids=["a model", "sizes", "sizes without mass"],
)
@pytest.mark.parametrize("tool", [HAND, {}], ids=["with a hand", "bare"])
def test_a_flange_moves_the_tool_outwards_by_its_thickness_and_adds_its_mass_to_the_arm(
    flange: dict[str, Any], thickness: float, mass: float, tool: dict[str, Any]
) -> None:
    plain, moved = (Robot.from_config(one_arm(tool=tool, flange=given)) for given in ({}, flange))
    expected = plain.tool_pose(POSTURE, "left") * pin.SE3(np.eye(3), np.array([0.0, 0.0, thickness]))
    np.testing.assert_allclose(moved.tool_pose(POSTURE, "left").homogeneous, expected.homogeneous, atol=1e-12)
    assert moved.model.inertias[7].mass - plain.model.inertias[7].mass == pytest.approx(mass)


def test_the_body_of_each_flange_is_monitored_against_everything_that_its_arm_can_meet() -> None:
    plain, robot = Robot.from_config(load_config("config/dual_iiwa7.yaml")), Robot.from_config(with_flange(TOUCH))
    new = watched(robot) - watched(plain)
    assert watched(plain) <= watched(robot), "nothing else is watched less"
    other = [f"left_link_{number}" for number in range(8)] + ["left_media_flange", "left_hand_e_envelope"]
    own = [f"right_link_{number}" for number in (0, 1)]
    for link in [*other, *own, "table", "floor"]:
        assert frozenset(("right_media_flange", link)) in new
    assert {link for pair in new for link in pair if link.startswith("right_link")} - {*own} == {
        f"right_link_{number}" for number in range(2, 8)
    }, "those only against the left arm's flange"
    assert not {pair for pair in new if pair & {"right_media_flange"} and pair & {"right_link_5", "right_link_2"}}


def test_the_sphere_of_the_touch_flange_encloses_the_flange_but_the_capsule_of_link_7_would_not() -> None:
    """The outline of the published mesh is given as radius by height z. The end of a plain flange is at z = 0 [m]."""
    outline = {-0.045: 0.055, -0.026: 0.0582, 0.0: 0.0553, 0.026: 0.0329}
    urdf = load_description("media_flange_touch_pneumatic").urdf
    sphere, centre = urdf.find("link/collision/geometry/sphere"), urdf.find("link/collision/origin")
    assert sphere is not None
    assert centre is not None
    radius, z = float(sphere.get("radius", "nan")), float(centre.get("xyz", "").split()[2])
    assert all(np.hypot(r, height - z) <= radius for height, r in outline.items())
    link_7 = max(np.hypot(r, height + 0.038) - 0.053 for height, r in outline.items())
    assert link_7 == pytest.approx(0.019, abs=5e-4)


def test_the_known_pairs_of_a_tool_on_an_arm_are_not_used_if_an_unknown_flange_is_between_them() -> None:
    far = '"left_link_4" link2="left_hand_e_envelope"'
    assert far in compose(one_arm(tool=HAND)).srdf
    assert far in compose(one_arm(tool=HAND, flange=TOUCH)).srdf
    assert far not in compose(one_arm(tool=HAND, flange=CYLINDER)).srdf
    elsewhere = one_arm(tool=HAND, flange=TOUCH, model="iiwa7", tip="link_6", home=[0.0] * 6)
    assert "media_flange" not in compose(elsewhere).srdf


def test_a_users_flange_can_be_a_urdf_whose_named_link_carries_the_tool(tmp_path: Path) -> None:
    """The flange is a coupler with a sensor beside it.

    It has two ends, and the cell names the one that carries the tool.
    """
    joint = '<joint name="{0}_joint" type="fixed"><parent link="disc"/><child link="{0}"/><origin xyz="{1}"/></joint>'
    links = '<link name="disc"/><link name="end"/><link name="side"/>'
    text = f'<robot name="disc">{links}{joint.format("end", "0 0 0.04")}{joint.format("side", "0.05 0 0.01")}</robot>'
    (tmp_path / "disc.urdf").write_text(text)
    model = str(tmp_path / "disc.urdf")
    with pytest.raises(ConfigError, match=r"arms\.left\.flange\.frame: the arm could end at end, side: name the link"):
        compose(one_arm(flange={"model": model}, tool=HAND))
    robot = Robot.from_config(one_arm(flange={"model": model, "frame": "end"}, tool=HAND))
    plain = Robot.from_config(one_arm(tool=HAND))
    way = plain.tool_pose(POSTURE, "left").actInv(robot.tool_pose(POSTURE, "left"))
    np.testing.assert_allclose(way.translation, [0.0, 0.0, 0.04], atol=1e-12)
