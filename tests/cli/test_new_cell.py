"""q2r2 new-cell writes cells for models that no shipped cell has, and refuses models that are not arms."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from tests.cli.command import one_object, q2r2

IIWA = find_resource("robots/iiwa7.urdf").read_text(encoding="utf-8")
ONE_JOINT = """<robot name="one"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>
<child link="b"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("text", "arguments", "says"),
    [
        pytest.param(ONE_JOINT, "--left arm.urdf", "joints that move b: 1; allowed: an arm", id="a single joint"),
        pytest.param("hello", "--left arm.urdf", "not XML", id="no robot"),
        pytest.param("<mujoco/>", "--left arm.xml", "--velocity: an MJCF has no limits of speed", id="no speed"),
        pytest.param("<mujoco/>", "--left arm.xml --velocity 1", "no joint that turns or slides", id="an empty MJCF"),
        pytest.param(IIWA, "--left arm.urdf --velocity 1", "--velocity: allowed with a model", id="speed of a URDF"),
        pytest.param(
            re.sub(r' (velocity|effort)="[^"]*"', "", IIWA),
            "--left arm.urdf",
            "A1 has no velocity and no effort limit, A2 has no velocity",
            id="no limits, all of them named",
        ),
        pytest.param(IIWA, "--left missing.urdf", "missing.urdf: no such file", id="no file"),
        pytest.param(IIWA, "--left arm.urdf --left-tip elbow", "--left-tip 'elbow': no such link", id="no such tip"),
        pytest.param(IIWA, "--left arm.urdf --robot arm.urdf", "--left, --right or --robot", id="two ways at once"),
        pytest.param(IIWA, "--robot arm.urdf", "no left and right among the ends", id="one arm that should be two"),
        pytest.param("", "--left example-robot-data:go2", "branches at base", id="a robot of legs"),
    ],
)
def test_the_command_new_cell_prints_one_line_and_writes_no_file_for_a_model_that_cannot_be_in_a_cell(
    text: str, arguments: str, says: str
) -> None:
    Path("arm.urdf").write_text(text)
    Path("arm.xml").write_text(text)
    result = q2r2("new-cell", "cell", *arguments.split(), "--yes")
    assert result.exit_code == 2
    assert says in result.stderr
    assert result.stderr.count("\n") == 1
    assert not Path("cell.yaml").exists()


def test_an_existing_file_is_not_overwritten() -> None:
    Path("cell.yaml").write_text("mine")
    told = "cell.yaml: exists; allowed: another name; q2r2 check cell.yaml is enough if only the model has changed"
    assert told in q2r2("new-cell", "cell", "--left", "iiwa7", "--yes").stderr
    assert Path("cell.yaml").read_text() == "mine"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder in which even root cannot write")
def test_a_folder_that_cannot_be_written_is_refused_before_the_models_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/proc")
    result = q2r2("new-cell", "cell", "--left", "missing.urdf", "--yes")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "cell cell.yaml: No such file or directory; allowed: a file in a folder" in result.stderr


@pytest.mark.slow
def test_a_fault_names_the_links_without_masses_and_a_line_says_that_this_fault_is_left_to_do() -> None:
    Path("arm.urdf").write_text(re.sub(r"<inertial>.*?</inertial>", "", IIWA, flags=re.DOTALL))
    result = q2r2("new-cell", "cell", "--left", "arm.urdf", "--yes", "--samples", "100")
    assert result.exit_code == 1
    told = "links that move without a mass, which simulation needs: left_link_1, left_link_2"
    assert result.stdout.count("FAULT") == 2  # The fault, and the line that says what is left to do.
    assert told in result.stdout
    assert "left to do" in result.stdout


@pytest.mark.slow
@pytest.mark.parametrize("link", ["link_3", "link_0"], ids=["a link that moves", "the base"])
def test_visible_links_without_collision_shapes_are_monitored_with_capsules_around_their_visual_geometry(
    link: str, tmp_path: Path
) -> None:
    Path("arm.urdf").write_text(re.sub(rf'<collision name="{link}.*?</collision>', "", IIWA, flags=re.DOTALL))
    result = q2r2("new-cell", "cell", "--left", "arm.urdf", "--yes", "--samples", "100")
    assert result.exit_code == 0, result.output
    assert f"NOTE left_{link}: drawn, without a collision shape, hence watched by capsules" in result.stdout
    cell = load_config(tmp_path / "cell.yaml")
    assert cell.capsules[f"left_{link}"] == 1
    watched = {link_of(name) for pair in pair_names(Robot.from_config(cell).collision_model) for name in pair}
    assert f"left_{link}" in watched


@pytest.mark.slow
def test_if_a_fixed_part_of_the_robot_is_always_near_an_arm_this_pair_gets_its_own_distance(tmp_path: Path) -> None:
    pillar = """<link name="pillar"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
      <joint name="stands" type="fixed"><parent link="link_0"/><child link="pillar"/><origin xyz="0.11 0 0.16"/></joint>
    </robot>"""
    Path("arm.urdf").write_text(IIWA.replace("</robot>", pillar))
    result = q2r2("new-cell", "cell", "--left", "arm.urdf", "--yes", "--samples", "100")
    assert result.exit_code == 0, result.output
    (pair,) = load_config(tmp_path / "cell.yaml").control.pairs
    assert (set(pair.pair), pair.distance) == ({"left_link_1", "left_pillar"}, 0.016)


@pytest.mark.slow
def test_if_the_visual_geometry_of_a_link_cannot_be_enclosed_other_links_still_get_capsules(tmp_path: Path) -> None:
    bare = re.sub(r'<collision name="link_[03].*?</collision>', "", IIWA, flags=re.DOTALL)
    Path("points.obj").write_text("v 0 0 0\n")
    drawing = '<link name="link_0"><visual><geometry><mesh filename="points.obj"/></geometry></visual>'
    Path("arm.urdf").write_text(re.sub(r'<link name="link_0">\s*', drawing, bare))
    result = q2r2("new-cell", "cell", "--left", "arm.urdf", "--yes", "--samples", "100")
    assert "NOTE no capsule around the drawing of left_link_0: " in result.stdout
    assert load_config(tmp_path / "cell.yaml").capsules["left_link_3"] == 1


@pytest.mark.slow
def test_the_answers_of_the_user_are_written_into_the_cell(tmp_path: Path) -> None:
    typed = "0.9\n0.1\n0 0.4 0 -1.6 0 1.1 0\n\n"
    models = ("--left", "iiwa7", "--right", "iiwa7")
    result = q2r2("new-cell", "cell", *models, "--samples", "100", typed=typed)
    assert result.exit_code == 0, result.output
    left, right = load_config(tmp_path / "cell.yaml").arms.values()
    assert (left.mount.position, right.mount.position) == ((0.0, 0.45, 0.1), (0.0, -0.45, 0.1))
    assert left.home == right.home == (0.0, 0.4, 0.0, -1.6, 0.0, 1.1, 0.0), "a twin's home is taken"


@pytest.mark.slow
def test_the_answers_of_an_interrupted_try_are_offered_in_the_next_try() -> None:
    command = ("new-cell", "cell", "--left", "iiwa7", "--right", "iiwa7", "--samples", "100")
    interrupted = q2r2(*command, typed="0.9\n0.1\n")  # The input ends at the third question.
    assert interrupted.exit_code != 0
    assert not Path("cell.yaml").exists()
    result = q2r2(*command, typed="\n\n\n\n")
    assert result.exit_code == 0, result.output
    assert "the answers of the last try are offered" in result.output
    left, right = load_config("cell.yaml").arms.values()
    assert (left.mount.position, right.mount.position) == ((0.0, 0.45, 0.1), (0.0, -0.45, 0.1))
    assert not Path("new-cell.answers.json").exists(), "nothing is left to do"


@pytest.mark.slow
def test_arguments_of_xacro_go_into_the_cell(tmp_path: Path) -> None:
    argument = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm"><xacro:arg name="fast" default="1.0"/>'
    text = re.sub(r"<robot[^>]*>", argument, re.sub(r'velocity="[^"]*"', 'velocity="$(arg fast)"', IIWA))
    Path("arm.urdf.xacro").write_text(text)
    model = ("--left", "arm.urdf.xacro", "--xacro-arg", "fast=1.25")
    result = q2r2("new-cell", "cell", *model, "--yes", "--samples", "100")
    assert result.exit_code == 0, result.output
    cell = load_config(tmp_path / "cell.yaml")
    assert cell.arms["left"].xacro_args == {"fast": "1.25"}
    assert Robot.from_config(cell).velocity_limit.tolist() == [1.25] * 7


@pytest.mark.slow
def test_an_mjcf_becomes_a_urdf_beside_the_new_cell_and_the_new_cell_runs(tmp_path: Path) -> None:
    bodies = "".join(
        f"""<body name="link_{i}" pos="0 0 {0.1 if i == 1 else 0.25}"><joint name="j{i}" axis="{axis}"
        range="-110 110" actuatorfrcrange="-200 200"/><geom type="capsule" fromto="0 0 0.06 0 0 0.19" size="0.05"/>"""
        for i, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1"), start=1)
    )
    base = '<body name="base"><geom type="cylinder" size="0.08 0.05"/>'
    Path("arm.xml").write_text(f"<mujoco><worldbody>{base}{bodies}{7 * '</body>'}</worldbody></mujoco>")
    models = ("--left", "arm.xml", "--right", "arm.xml")
    result = q2r2("new-cell", "cell", *models, "--samples", "100", typed="1.5\n1.0\n0.1\n\n\n")
    assert result.exit_code == 0, result.output
    assert {arm.model for arm in load_config(tmp_path / "cell.yaml").arms.values()} == {
        str(tmp_path / "cell_left.urdf")
    }
    run = q2r2("run", "cell.yaml", *["--plant", "mujoco", "--fast", "--headless", "--duration", "2", "--json"])
    assert run.exit_code == 0, run.output
    assert max(arm["position_error_mm_rms"] for arm in one_object(run.stdout)["arms"].values()) < 1.0
    Path("cell.yaml").unlink()
    Path("cell.srdf").unlink(missing_ok=True)
    assert "cell_left.urdf: exists; give it as --left" in q2r2("new-cell", "cell", *models, "--yes").stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--left", "arm.urdf.xacro", "--xacro-arg", "fast"), "--xacro-arg 'fast': allowed: NAME=VALUE"),
        (("--left", "iiwa7", "--xacro-arg", "fast=1"), "--xacro-arg: allowed with a model that ends in .xacro"),
    ],
)
def test_a_malformed_xacro_argument_is_refused(arguments: tuple[str, ...], says: str) -> None:
    assert says in q2r2("new-cell", "cell", *arguments, "--yes").stderr


@pytest.mark.slow
def test_both_arms_of_one_model_are_found_with_their_fingers(tmp_path: Path) -> None:
    made = one_object(
        q2r2("new-cell", "cell", "--robot", "example-robot-data:baxter", "--yes", "--samples", "100", "--json").stdout
    )
    assert made["faults"] == []
    fits = [fit["wasted"] for fit in made["capsules"]["example-robot-data:baxter"]]
    assert fits == sorted(fits, reverse=True)
    cell = load_config(tmp_path / "cell.yaml")
    assert cell.robot is not None
    assert cell.robot.mount.position[2] == pytest.approx(0.93, abs=0.02), "its feet stand on the floor"
    made_robot = Robot.from_config(cell)
    left, right = (made_robot.tool_pose(made_robot.home, side).translation for side in ("left", "right"))
    assert right == pytest.approx(left * [1.0, -1.0, 1.0], abs=0.005), "their homes mirror each other"
    for arm in cell.arms.values():
        assert arm.gripper.open_position > arm.gripper.closed_position == 0.0


@pytest.mark.slow
def test_two_links_are_ignored_only_if_all_pairs_of_their_shapes_overlap(tmp_path: Path) -> None:
    ball = '<collision><origin xyz="0 0 0.2"/><geometry><sphere radius="0.17"/></geometry></collision></link>'
    head, tail = re.split(r"</link>\s*(?=<joint name=\"A2\")", IIWA)
    Path("arm.urdf").write_text(f"{head}{ball}{tail}")
    q2r2("new-cell", "cell", "--left", "arm.urdf", "--yes", "--samples", "100")
    robot = Robot.from_config(load_config(tmp_path / "cell.yaml"))
    assert ("left_link_1_1", "left_link_3_0") in robot.ignored_pairs
    assert ("left_link_1_0", "left_link_3_0") in pair_names(robot.collision_model)


@pytest.mark.slow
def test_meshes_that_one_capsule_fits_badly_get_several_capsules_with_which_a_run_succeeds(tmp_path: Path) -> None:
    model = "example-robot-data:ur5"
    made = one_object(
        q2r2("new-cell", "cell", "--left", model, "--right", model, "--yes", "--samples", "100", "--json").stdout
    )
    assert made["faults"] == []
    better = {fit["link"]: fit for fit in made["capsules"][model] if fit["capsules"] > 1}
    assert {link: fit["capsules"] for link, fit in better.items()} == {"forearm_link": 3, "upper_arm_link": 3}
    assert all(fit["then_wasted"] < 0.5 * fit["wasted"] for fit in better.values())
    cell = load_config(tmp_path / "cell.yaml")
    assert cell.capsules == {f"{side}_{link}": 3 for side in ("left", "right") for link in better}
    pairs, before = map(int, re.findall(r"(\d+) pairs instead of (\d+)", made["notes"][0])[0])
    assert before < pairs == len(Robot.from_config(cell).collision_model.collisionPairs)
    run = q2r2("run", "cell.yaml", *["--plant", "mujoco", "--fast", "--headless", "--duration", "2", "--json"])
    assert run.exit_code == 0, run.output
    arms = one_object(run.stdout)["arms"].values()
    assert max(arm["position_error_mm_rms"] for arm in arms) < 1.0
