"""Faults in the block ``external``, which describes another controller, are reported like faults in other blocks."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent

import pinocchio as pin
import pytest

from q2r2_control import Robot
from q2r2_control.config.cell_file import parse_config
from q2r2_control.config.resources import find_resource
from q2r2_control.config.yaml_text import read_yaml, yaml_of
from tests.config.cell_files import changed, fault, loaded
from tests.support.external_cell import external

LEFT = {"left": external()["external"]["arms"]["left"]}
ROBOT = "/bh_robot/left_arm_clik_controller"
UNCLEAR = {
    "no block": (changed("controller", "external"), "controller = 'external': needs the block external, with preset"),
    "a block too many": (
        changed("controller", "builtin", external),
        "external: allowed with controller: ext",
    ),
    "an arm missing": (changed("external.arms", LEFT, external), "external.arms: without right; needed: left, right"),
    "an arm too many": (
        changed("arms", {"left": external()["arms"]["left"]}, external),
        "external.arms.right: the cell has no such arm; allowed: left",
    ),
    "one topic for both": (
        changed("external.arms.right.ctrl_prefix", ROBOT, external),
        f"external.arms: both have commands {ROBOT}/target_frame; allowed: one of its own for each arm",
    ),
    "one tool for both": (
        changed("external.arms.right.tool_frame", "left_arm_link_ee", external),
        "external.arms: both have tool_frame left_arm_link_ee; allowed: one of its own for each arm",
    ),
}


@pytest.mark.parametrize(("text", "says"), UNCLEAR.values(), ids=UNCLEAR)
def test_a_cell_is_refused_if_it_does_not_say_clearly_which_controller_moves_which_arm(
    tmp_path: Path, text: str, says: str
) -> None:
    assert fault(tmp_path, text).startswith(says)


def test_limits_of_targets_are_refused_for_a_preset_that_takes_joint_positions(tmp_path: Path) -> None:
    cell = external()
    cell["external"] |= {"preset": "jtc"}
    del cell["external"]["mode"]
    loaded_cell = loaded(tmp_path, yaml_of(cell))
    assert loaded_cell.external is not None
    assert loaded_cell.external.filtered, "who does not choose is protected"
    cell["external"]["mode"] = "raw"
    assert fault(tmp_path, yaml_of(cell)).startswith("external: preset = 'jtc' with mode = 'raw'")
    cell["external"]["mode"] = "filtered"
    cell["external"]["limits"]["max_velocity"] = 0.2
    assert "preset jtc gets joint positions within the limits of the block control" in fault(tmp_path, yaml_of(cell))


PAGE = (Path(__file__).resolve().parents[2] / "docs" / "kuka.md").read_text(encoding="utf-8")


def test_the_yaml_blocks_of_kuka_md_are_valid_in_a_cell() -> None:
    lbr, kuka_drivers = (read_yaml(dedent(block)) for block in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL))
    cell = read_yaml(find_resource("config/dual_iiwa14.yaml").read_text(encoding="utf-8"))
    config = parse_config(yaml_of(cell | kuka_drivers), "cell.yaml")
    assert config.external is not None
    assert config.external.topic("left") == "/left/joint_trajectory_controller/joint_trajectory"
    right = {key: value.replace("left", "right") for key, value in lbr["left"].items()}
    driven = {"preset": "lbr_position", "mode": "filtered", "arms": lbr | {"right": right}}
    config = parse_config(yaml_of(cell | {"controller": "external", "external": driven}), "cell.yaml")
    assert config.external is not None
    assert config.external.topic("left") == "/left/command/lbr_joint_position_command"


@pytest.mark.parametrize(("name", "frame", "base"), [("iiwa7", "link_ee", 1.266), ("iiwa14", "link_7", 1.261)])
def test_the_command_in_kuka_md_publishes_the_tool_frame_of_the_shipped_cell_on_tf(
    name: str, frame: str, base: float
) -> None:
    """``base`` is the height of ``frame`` above the base of the upright arm in the driver's own model [m]."""
    text = find_resource(f"config/dual_{name}.yaml").read_text(encoding="utf-8")
    robot = Robot.from_config(parse_config(text, "cell.yaml"))
    stretched = pin.neutral(robot.model)
    tool = (
        robot.tool_pose(stretched, "left").translation
        - robot.model.frames[robot.model.getFrameId("left_link_0")].placement.translation
    )
    (given,) = re.findall(rf"--frame-id left_{frame} --child-frame-id left_tool_frame --z ([\d.]+)", PAGE)
    assert base + float(given) == pytest.approx(tool[2], abs=1e-6)
