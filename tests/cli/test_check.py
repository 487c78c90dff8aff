"""q2r2 check lists the parts of a cell, its faults, and the pairs that can never meet."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from q2r2_control.cli.cell_report import check_cell, cost_of_shapes
from q2r2_control.config.bindings import Action, BindingSettings
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.robot.description import load_description
from q2r2_control.verification.fault_injection import FINGERS, with_contact
from tests.cli.command import CELL, changed_cell, external_cell, one_object, q2r2
from tests.robot.conftest import one_arm

ARM = one_arm()


def test_check_prints_arms_limits_obstacles_and_the_nearest_pairs_of_a_good_cell() -> None:
    result = q2r2("check", CELL)
    assert result.exit_code == 0
    for expected in ("left_A1", "right_A7", "hand_e", "left_tool_frame", "table", "monitored pairs", "min_distance 20"):
        assert expected in result.stdout
    assert "arms driven by the built-in controller\n" in result.stdout
    assert "FAULT" not in result.stdout
    assert result.stdout.endswith("\nthis cell can run\n")


def other_arms(folder: Path, pattern: str, new: str) -> str:
    """Return the shipped cell with changed models of its arms. Each text that fits ``pattern`` is replaced."""
    text = find_resource("robots/iiwa7.urdf").read_text(encoding="utf-8")
    (folder / "other.urdf").write_text(re.sub(pattern, new, text, flags=re.DOTALL), encoding="utf-8")
    cell = find_resource(CELL).read_text(encoding="utf-8").replace("model: iiwa7", f"model: {folder / 'other.urdf'}")
    (folder / "cell.yaml").write_text(cell, encoding="utf-8")
    return str(folder / "cell.yaml")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pattern", "new", "fault"),
    [
        (r'ixx="[^"]*"', 'ixx="9"', "inertia must satisfy"),
        (
            r"<collision name=.*?</collision>",
            "",
            "left arm: no link between its base and its tool has a collision shape",
        ),
    ],
    ids=["an inertia that no body has", "no collision shapes"],
)
def test_check_refuses_arms_that_a_run_refuses(tmp_path: Path, pattern: str, new: str, fault: str) -> None:
    cell = other_arms(tmp_path, pattern, new)
    checked, ran = q2r2("check", cell), q2r2("run", cell, "--fast", "--headless", "--duration", "0.1")
    assert checked.exit_code == 1
    assert re.search(f"FAULT .*{fault}", checked.stdout)
    assert re.search(r"\nthis cell cannot run: \d faults?\n$", checked.stdout)
    assert ran.exit_code == 2
    assert fault in ran.stderr


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("model: iiwa7", "model: /nowhere.urdf", "model = '/nowhere.urdf'"),
        ("home: [", "home: [0.1, ", "home"),
    ],
)
def test_check_names_both_arms_if_both_have_the_same_fault(tmp_path: Path, old: str, new: str, fault: str) -> None:
    (file := tmp_path / "cell.yaml").write_text(find_resource(CELL).read_text(encoding="utf-8").replace(old, new))
    checked, ran = q2r2("check", str(file)), q2r2("run", str(file), "--fast", "--headless", "--duration", "0.1")
    assert (checked.exit_code, ran.exit_code) == (2, 2)
    for stderr in (checked.stderr, ran.stderr):
        assert [line.partition(fault)[0] for line in stderr.splitlines()] == ["q2r2: arms.left.", "q2r2: arms.right."]
    assert checked.stdout.endswith("this cell cannot run: 2 faults\n")


def test_a_heavy_link_without_a_shape_is_a_fault_until_the_cell_names_it(tmp_path: Path) -> None:
    cell = other_arms(tmp_path, r'<collision name="link_3.*?</collision>', "")
    checked, ran = q2r2("check", cell), q2r2("run", cell, "--fast", "--headless", "--duration", "0.1")
    says = "_link_3: weighs 3.39 kg and has no collision shape"
    assert (checked.exit_code, ran.exit_code) == (1, 2)
    assert f"FAULT left{says}" in checked.stdout
    assert "FAULT right" in checked.stdout
    assert f"left{says}" in ran.stderr
    assert checked.stdout.endswith("\nthis cell cannot run: 2 faults\n")
    text = Path(cell).read_text(encoding="utf-8")
    Path(cell).write_text(text.replace("unchecked_links: []", "unchecked_links: [left_link_3, right_link_3]"))
    named = q2r2("check", cell)
    assert (named.exit_code, "FAULT" in named.stdout) == (0, False)
    assert "NOTE unchecked_links: nothing keeps left_link_3, right_link_3 off anything\n" in named.stdout


def test_check_and_run_list_all_faults_of_a_file(tmp_path: Path) -> None:
    (file := tmp_path / "cell.yaml").write_text(
        "name: cell\narms: {left: {model: iiwa7, home: [0, 0, 0, 0, 0, 0, up]}}\nfloor: low\n"
        "control: {solvr: daqp, min_distance: -1}\n",
        encoding="utf-8",
    )
    lines = [
        f"q2r2: {file}, line 4: control.solvr = 'daqp': unknown key; did you mean solver? allowed here: ",
        f"q2r2: {file}, line 2: arms.left.home.6 = 'up': allowed: a number",
        f"q2r2: {file}, line 3: floor = 'low': allowed: a number, or null",
        f"q2r2: {file}, line 4: control.min_distance = -1: allowed: 0 or more",
    ]
    checked, ran = q2r2("check", str(file)), q2r2("run", str(file), "--headless")
    data = q2r2("check", str(file), "--json")
    assert checked.exit_code == data.exit_code == ran.exit_code == 2
    for result in (checked, ran):
        said = result.stderr.splitlines()
        assert len(said) == len(lines)
        assert all(line.startswith(start) for line, start in zip(said, lines, strict=True)), said
    assert checked.stdout == "this cell cannot run: 4 faults\n"
    found = one_object(data.stdout)
    assert [f"q2r2: {fault}"[: len(line)] for fault, line in zip(found["faults"], lines, strict=True)] == lines
    assert found["verdict"] == "this cell cannot run: 4 faults"


def test_check_also_prints_a_verdict_for_a_model_that_cannot_be_read(tmp_path: Path) -> None:
    result = q2r2("check", changed_cell(tmp_path, "model: iiwa7", "model: iiwa8"))
    assert (result.exit_code, result.stdout) == (2, "this cell cannot run: 1 fault\n")
    assert "iiwa8" in result.stderr


def test_check_compiles_no_kernel(tmp_path: Path) -> None:
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "q2r2_control", "check", CELL]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
    assert not any(tmp_path.rglob("*.nb?"))


def test_check_names_the_controller_and_the_mode(tmp_path: Path) -> None:
    file = external_cell(tmp_path)
    topic = "/bh_robot/right_arm_clik_controller/target_frame"
    source = "what the built-in controller makes of the hand's target"
    takes = "it takes: active; keeps the last target for ever"
    line = f"kuka_lbr_clik: PoseStamped in bh_robot_base on {topic} at 100 Hz, {source}; {takes}"
    assert f"right driven by {line}\n" in q2r2("check", file).stdout
    assert one_object(q2r2("check", file, "--json").stdout)["driven"]["right"] == line


def test_check_says_which_limits_raw_targets_do_not_have(tmp_path: Path) -> None:
    line = "raw: no limits, no distances, no self-collision"
    assert f"NOTE {line}\n" in q2r2("check", external_cell(tmp_path, new="mode: raw")).stdout
    assert line not in q2r2("check", external_cell(tmp_path)).stdout


def test_check_refuses_a_filtered_cell_whose_operator_moves_another_frame_than_the_tool(tmp_path: Path) -> None:
    text = Path(external_cell(tmp_path)).read_text(encoding="utf-8")
    (file := tmp_path / "cell.yaml").write_text(text.replace("left_arm_link_ee", "left_link_ee"), encoding="utf-8")
    result = q2r2("check", str(file))
    assert result.exit_code == 2
    assert "external.arms.left.tool_frame = 'left_link_ee': 0.144 m and 0.00 rad from left_tool_frame" in result.stderr
    assert "allowed: a frame at the tool, or null with left_tool_frame on /tf" in result.stderr


def test_the_json_of_check_has_limits_and_the_distances_of_pairs_in_ascending_order() -> None:
    cell = one_object(q2r2("check", CELL, "--json").stdout)
    assert [arm["name"] for arm in cell["arms"]] == ["left", "right"]
    joint = cell["arms"][0]["joints"][0]
    assert joint["name"] == "left_A1"
    assert joint["lower"] == pytest.approx(-2.967, abs=1e-3)
    assert joint["velocity"] == pytest.approx(1.71, abs=0.01)
    distances = [pair["distance"] for pair in cell["nearest"]]
    assert distances == sorted(distances)
    assert cell["monitored_pairs"] > len(distances) > 3
    assert cell["faults"] == cell["notes"] == []
    joint, other = (cell["stop_torques"][1]["joints"][index] for index in (1, 3))
    assert (joint["joint"], joint["acceleration"]) == ("right_A2", 5.44)
    assert other["acceleration"] == 10.0, "the smaller one of the joint's and control.acceleration_limit"
    assert 0.0 < joint["gravity"] < joint["stop"] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        pytest.param("home: [0.0204, 0.348,", "home: [0.0204, 1.0,", "left_hand_e_envelope_0 and table_0", id="table"),
        pytest.param("0.0204, 0.348,", "0.0204, 2.09,", "left_A2 = 2.09; allowed: -2.0844 .. 2.0844", id="limits"),
    ],
)
def test_check_lists_what_is_wrong_at_home_and_exits_with_1(tmp_path: Path, old: str, new: str, fault: str) -> None:
    file = changed_cell(tmp_path, old, new)
    shown, data = q2r2("check", file), q2r2("check", file, "--json")
    assert shown.exit_code == data.exit_code == 1
    assert f"FAULT home: {fault}" in shown.stdout
    assert any(fault in line for line in one_object(data.stdout)["faults"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("written", "says"),
    [
        pytest.param("", "at the end of the cell's YAML:", id="no block of that name"),
        pytest.param(
            "control:\n  min_distance: 0.02\n", "below control in the cell's YAML:", id="a block without pairs"
        ),
        pytest.param(
            "control:\n  pairs:\n    - {pair: ['*_forearm_link', '*_wrist_3_link'], distance: 0.001}\n",
            "below control.pairs in the cell's YAML:",
            id="other pairs",
        ),
        pytest.param("srdf: mine.srdf\ncontrol:\n  min_distance: 0.02\n", "/mine.srdf:", id="an SRDF"),
    ],
)
def test_a_cell_becomes_valid_with_the_lines_that_check_prints_for_links_that_are_too_near(
    tmp_path: Path, written: str, says: str
) -> None:
    bare = load_description("example-robot-data:ur5").file  # A model that is loaded by its path has no SRDF.
    arm = f"{{model: {bare}, tip: tool0, mount: {{position: [0, 0, 0.1]}}, home: [-0.6, -1.1, 1.0, -1.4, -0.6, 0]}}"
    (cell := tmp_path / "cell.yaml").write_text(f"name: my cell\narms:\n  left: {arm}\n{written}", encoding="utf-8")
    (tmp_path / "mine.srdf").write_text('<robot name="cell">\n</robot>\n', encoding="utf-8")
    refused = q2r2("check", str(cell))
    assert refused.exit_code == 1
    assert says in refused.stdout
    *lines, verdict = refused.stdout.splitlines()
    assert verdict.startswith("this cell cannot run")
    last_fault = max(number for number, line in enumerate(lines) if line.startswith("FAULT"))
    for line in lines[last_fault + 1 :]:
        if line.endswith(".srdf:"):
            file, end = tmp_path / line.split()[-1].rstrip(":"), "</robot>\n" if "before" in line else None
        elif line.endswith("YAML:"):
            file, end = cell, None
        else:
            before = file.read_text(encoding="utf-8") if file.exists() else ""
            before, tail = before.removesuffix(end or ""), end or ""
            file.write_text(f"{before}{line}\n{tail}", encoding="utf-8")
    assert q2r2("check", str(cell)).exit_code == 0


def test_check_says_how_to_remove_a_floor_that_overlaps_the_robot(tmp_path: Path) -> None:
    low = changed_cell(tmp_path, "[0.0, 0.4, 0.0]", "[0.0, 0.4, -0.6]")
    lines = [line for line in q2r2("check", low).stdout.splitlines() if line.startswith("FAULT") and "floor_0" in line]
    assert lines
    assert all(line.endswith("; the key floor takes another height, or null for no floor") for line in lines)
    text = Path(low).read_text(encoding="utf-8").replace("floor: 0.0 ", "floor: null ")
    Path(low).write_text(text.replace("position: [0.75, 0.0, 0.1]", "position: [0.75, 0.0, -0.6]"), encoding="utf-8")
    result = q2r2("check", low)
    assert (result.exit_code, "floor" in result.stdout) == (0, False)


def test_a_stop_that_needs_too_much_torque_causes_a_note_and_no_fault(tmp_path: Path) -> None:
    fast = changed_cell(tmp_path, "acceleration_limit: {}", "acceleration_limit: {A1: 10.0, A2: 10.0, A3: 10.0}")
    result = q2r2("check", fast)
    (note,) = (line for line in result.stdout.splitlines() if line.startswith("NOTE "))
    assert re.search(
        r"^NOTE left arm: in a full stop .* left_A2 needs up to 1\.09 times its torque limit; some joint needs too "
        r"much in 9\.\d % of 5000 random postures. To change: arms\.left\.acceleration_limit: "
        r"{A1: 8\.\d+, A2: 8\.\d+, .*}, or control\.acceleration_limit: 8\.\d+$",
        note,
    )
    assert result.exit_code == 0
    cell = one_object(q2r2("check", fast, "--json").stdout)
    assert [f"NOTE {note}" for note in cell["notes"]] == [note]
    assert cell["stop_torques"][0]["stop"]["share_over"] > 0.09
    assert cell["stop_torques"][1]["stop"]["share_over"] == 0.0


def test_if_a_fault_says_that_limits_are_in_degrees_no_note_asks_for_the_units_of_these_limits(tmp_path: Path) -> None:
    urdf = ET.fromstring(find_resource("robots/iiwa7.urdf").read_text(encoding="utf-8"))
    limits = {joint.get("name"): limit for joint in urdf.findall("joint") for limit in joint.findall("limit")}
    for name in ("A3", "A4"):
        limits[name].attrib.update(lower="-120", upper="120", velocity="130")
    # The position limits of A5 are in radians. Only the user knows whether its velocity limit is in degrees.
    limits["A5"].set("velocity", "130")
    (tmp_path / "arm.urdf").write_text(ET.tostring(urdf, encoding="unicode"))
    report = check_cell(one_arm(model=str(tmp_path / "arm.urdf")))
    assert [fault.partition(":")[0] for fault in report.faults] == ["left_A3, left_A4"]
    assert [note.partition(" has limits")[0] for note in report.notes if "degrees" in note] == ["left arm: A5"]


def test_if_gravity_alone_needs_too_much_torque_the_note_does_not_advise_slower_stops(tmp_path: Path) -> None:
    urdf = find_resource("robots/iiwa7.urdf").read_text(encoding="utf-8")
    assert urdf.count('velocity="2.268928" effort="110"') == 1  # Only A4 has this line.
    (tmp_path / "arm.urdf").write_text(urdf.replace('velocity="2.268928" effort="110"', 'velocity="2.2" effort="12"'))
    (note,) = check_cell(one_arm(model=str(tmp_path / "arm.urdf"))).notes
    assert re.search(
        r"^left arm: at rest, by gravity alone left_A4 needs up to \d\.\d\d times its torque limit; "
        r"some joint .* postures. To change: the model's torque limits, masses and position limits$",
        note,
    )


def test_check_prints_a_note_about_a_control_for_grippers_that_do_not_exist() -> None:
    def notes_with(gripper: dict[str, object]) -> list[str]:
        cell = one_arm(tool={"model": "hand_e", "frame": "tool_frame"}, gripper=gripper)
        bindings = BindingSettings(upper=Action.NONE, trigger=Action.GRIPPER_ANALOG)
        return check_cell(cell.model_copy(update={"teleop": TeleopSettings(bindings=bindings)})).notes

    assert notes_with({}) == [
        "teleop.bindings: trigger is gripper_analog, but no arm has a gripper; allowed: arms.*.gripper.joints"
    ]
    assert notes_with({"joints": ["finger_joint_1", "finger_joint_2"], "open_position": 0.025}) == []


def test_check_says_which_pairs_may_touch() -> None:
    cell = with_contact(load_config("config/dual_iiwa7.yaml"), FINGERS)
    report = check_cell(cell)
    notes = [note for note in report.notes if "may touch in torque mode" in note]
    assert len(notes) == len(cell.control.contact_allowed) == len(report.contacts)
    for note, allowed in zip(notes, cell.control.contact_allowed, strict=True):
        assert all(name in note for name in allowed.pair)
        assert f"inside by up to {1e3 * allowed.depth:g} mm" in note


@pytest.mark.parametrize(
    ("ticks", "says"),
    [
        ((49e-6, 31e-6), "320 pairs instead of 193, a tick at home 49 instead of 31 us"),
        ((31e-6, 49e-6), "320 pairs instead of 193"),
        ((31.2e-6, 31.1e-6), "320 pairs instead of 193"),
    ],
)
def test_the_text_about_additional_shapes_contains_times_only_if_the_shapes_make_ticks_longer(
    ticks: tuple[float, float], says: str
) -> None:
    assert cost_of_shapes((320, 193), ticks) == says


def test_pairs_that_can_never_meet_are_written_to_new_files_only(tmp_path: Path) -> None:
    (file := tmp_path / "cell.srdf").write_text("mine", encoding="utf-8")
    assert "exists; give the name of a new file" in q2r2("check", CELL, "--pairs", str(file)).stderr
    assert file.read_text(encoding="utf-8") == "mine"


def test_a_file_of_pairs_that_cannot_be_written_is_refused_before_postures_are_sampled(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    refused = q2r2("check", CELL, "--pairs", str(tmp_path / "file" / "a.srdf"), "--samples", "1000000000")
    assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
    assert "a.srdf: Not a directory; allowed: a file in a folder" in refused.stderr
