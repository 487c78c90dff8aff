"""Leader arms: the pose of a hand is computed from joint positions, in degrees or as percentages of their ranges."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from q2r2_devices.leader import LeaderArm, LeaderSettings, trigger_of

from q2r2_control import ConfigError, InputError
from tests.devices.leader_arm import JOINTS, place, write_urdf

NAMES = [*(f"{joint}.pos" for joint in JOINTS), "gripper.pos"]
AT_ZERO = dict.fromkeys(NAMES, 0.0)


def arm(folder: Path, names: list[str] = NAMES, **settings: Any) -> LeaderArm:
    return LeaderArm(LeaderSettings(**{"urdf": str(write_urdf(folder)), "tool": "tool"} | settings), names)


@pytest.mark.parametrize(
    ("settings", "action", "angles"),
    [
        pytest.param({}, {"shoulder_pan.pos": 30.0}, {"pan": math.radians(30.0)}, id="degrees"),
        pytest.param(
            {},
            {"shoulder_lift.pos": -40.0, "elbow_flex.pos": 70.0},
            {"lift": math.radians(-40.0), "elbow": math.radians(70.0)},
            id="two joints",
        ),
        pytest.param({"units": "range"}, {"shoulder_pan.pos": 50.0}, {"pan": math.pi / 4.0}, id="a part of the range"),
        pytest.param({"units": "range"}, {"elbow_flex.pos": -100.0}, {"elbow": -math.pi / 2.0}, id="end of the range"),
        pytest.param(
            {"joints": {"shoulder_pan": "-shoulder_pan"}},
            {"shoulder_pan.pos": 30.0},
            {"pan": math.radians(-30.0)},
            id="a joint that turns the other way",
        ),
        pytest.param(
            {"joints": {"shoulder_pan": "elbow_flex", "elbow_flex": "shoulder_pan"}},
            {"shoulder_pan.pos": 30.0},
            {"elbow": math.radians(30.0)},
            id="joints with other names",
        ),
    ],
)
def test_the_position_of_the_tool_is_computed_from_the_positions_of_the_joints(
    tmp_path: Path, settings: dict[str, Any], action: dict[str, float], angles: dict[str, float]
) -> None:
    position, quaternion = arm(tmp_path, **settings).tool(AT_ZERO | action)
    np.testing.assert_allclose(position, place(**angles), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-9)


def test_a_roll_of_the_wrist_turns_the_tool(tmp_path: Path) -> None:
    _, quaternion = arm(tmp_path).tool(AT_ZERO | {"wrist_roll.pos": 60.0})
    np.testing.assert_allclose(quaternion, (0.5, 0.0, 0.0, math.sqrt(0.75)), atol=1e-9)


@pytest.mark.parametrize(
    ("names", "settings", "told"),
    [
        pytest.param(NAMES, {"urdf": "none.urdf"}, "leader.urdf = none.urdf: cannot be read", id="no file"),
        pytest.param(NAMES, {"tool": "hand"}, "leader.tool = hand: no frame of ", id="no such tool"),
        pytest.param(
            ["a.pos"], {}, r"leader.joints.a = a: not such a joint of .*; allowed: shoulder_pan, ", id="joint"
        ),
        pytest.param(
            ["a.pos"],
            {"joints": {"a": "free"}},
            "leader.joints.a = free: not such a joint",
            id="a joint without an angle",
        ),
        pytest.param(
            NAMES,
            {"joints": {"shoulder_pam": "shoulder_pan"}},
            "leader.joints.shoulder_pam: not such a joint of the teleoperator; allowed: shoulder_pan, shoulder_lift",
            id="a name that the teleoperator does not have",
        ),
        pytest.param(
            NAMES,
            {"joints": {"elbow_flex": "wrist_flex"}},
            "leader.joints.elbow_flex: two joints move the same joint of the URDF; allowed: one",
            id="two joints that are the same joint of the URDF",
        ),
        pytest.param(["delta_x"], {}, "leader: the teleoperator gives delta_x; allowed: positions", id="no leader"),
    ],
)
def test_a_leader_that_does_not_fit_its_urdf_is_refused(
    tmp_path: Path, names: list[str], settings: dict[str, Any], told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        arm(tmp_path, names, **settings)


def test_a_joint_without_limits_is_refused_unless_its_position_is_in_degrees(tmp_path: Path) -> None:
    text = write_urdf(tmp_path).read_text()
    (other := tmp_path / "other.urdf").write_text(text.replace(f'upper="{math.pi / 2.0}"', f'upper="{-math.pi / 2.0}"'))
    assert arm(tmp_path, urdf=str(other)).tool(AT_ZERO)
    with pytest.raises(ConfigError, match=r"shoulder_pan: the URDF gives no limits; allowed: units: degrees"):
        arm(tmp_path, urdf=str(other), units="range")


@pytest.mark.parametrize(("gripper", "trigger"), [(100.0, 0.0), (0.0, 1.0), (25.0, 0.75), (103.0, 0.0), (-2.0, 1.0)])
def test_a_closed_handle_is_a_pressed_trigger(gripper: float, trigger: float) -> None:
    assert trigger_of({"gripper.pos": gripper}) == trigger
    assert trigger_of({}) == 0.0


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_position_that_is_no_finite_number_is_refused_with_the_name_of_its_joint(
    tmp_path: Path, value: float
) -> None:
    leader = arm(tmp_path)
    with pytest.raises(InputError, match=rf"^elbow_flex.pos = {value}: allowed: a finite number$"):
        leader.tool(AT_ZERO | {"elbow_flex.pos": value})
    with pytest.raises(InputError, match=rf"^gripper.pos = {value}: allowed: a finite number$"):
        trigger_of({"gripper.pos": value})
