"""The q2r2 command, as a user or a script meets it."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from q2r2_control.cli.app import app
from q2r2_control.cli.progress_lines import ProgressLines
from q2r2_control.config.cell import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.verification.soak import SoakReport, run_soak
from tests.support.external_cell import external_text
from tests.support.fake_headset import FakeHeadset

CELL = "config/dual_iiwa7.yaml"
COMMANDS = ("demo", "run", "check", "headset-check", "bench", "soak")
FAST = ("run", CELL, "--plant", "kinematic", "--fast", "--json", "--headless")
SUMMARY_KEYS = {
    "ticks",
    "duration_s",
    "loop_rate_hz",
    "tick_us",
    "input_to_command_ms",
    "arms",
    "min_distance_mm",
    "closest_pair",
    "max_velocity_ratio",
    "max_acceleration_ratio",
    "min_position_margin_rad",
    "fallback_ticks",
    "rejected_targets",
    "events",
}
ARM_KEYS = {
    "engaged_s",
    "position_error_mm_rms",
    "rotation_error_deg_rms",
    "gripper_changes",
    "slip_mm_max",
    "slip_deg_max",
}


def q2r2(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


def one_object(text: str) -> dict[str, Any]:
    """The one JSON object on the one line that stdout has to be."""
    assert text.count("\n") == 1
    found = json.loads(text, parse_constant=pytest.fail)
    assert isinstance(found, dict)
    return found


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", "from q2r2_control.cli.app import app; app()", *arguments]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield running
    finally:
        running.kill()
        running.communicate()


def bound_port(running: subprocess.Popen[str]) -> int:
    """What the documented line on stderr says."""
    assert running.stderr is not None
    for line in running.stderr:
        if line.startswith("headset: listening on "):
            return int(line.rsplit(":", 1)[1])
    return pytest.fail("the command ended without naming its address")


def fake_headset(port: int, duration: float) -> None:
    """A headset in a process of its own that engages both arms and circles."""
    arguments = ["--port", str(port), "--script", "circle", "--duration", str(duration)]
    subprocess.run([sys.executable, "-m", "tests.support.fake_headset", *arguments], check=True, timeout=30)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_lists_every_command_whose_own_has_an_example(command: str) -> None:
    assert f"\n  {command} " in q2r2("--help").stdout
    assert f"Example: q2r2 {command}" in q2r2(command, "--help").stdout


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        pytest.param((), "Missing command", id="no command"),
        pytest.param(("rum",), "'rum'", id="an unknown command"),
        pytest.param(("run",), "CONFIG", id="run without a config"),
        pytest.param(("run", "nowhere.yaml"), "nowhere.yaml: no such file", id="a file that does not exist"),
        pytest.param(("run", CELL, "--input", "mind"), "'mind'", id="an unknown input"),
        pytest.param(
            ("run", CELL, "--plant", "kinematic", "--mode", "torque", "--duration", "1"),
            "mode torque: KinematicPlant follows position, velocity commands only",
            id="torque of a plant that has none",
        ),
        pytest.param(("run", CELL, "--duration", "nan"), "--duration nan: allowed", id="a duration that is not finite"),
        pytest.param(("demo", "juggle"), "task 'juggle': allowed: meet, grasp", id="a task that no demo has"),
        pytest.param(("demo", "--fast", "--rt"), "exclude each other", id="a demo in simulated real time"),
        pytest.param(("run", CELL, "--fast"), "--fast needs --duration", id="simulated time without an end"),
        pytest.param(
            ("run", CELL, "--input", "headset", "--fast", "--duration", "1"),
            "--fast cannot be used with --input headset",
            id="simulated time with a headset",
        ),
        pytest.param(
            ("run", CELL, "--input", "headset", "--trajectory", "circle"),
            "--trajectory",
            id="a trajectory of a headset",
        ),
        pytest.param(("run", CELL, "--port", "0"), "--port", id="a port for a script"),
        pytest.param(("run", CELL, "--viewer", "--headless"), "--viewer", id="a window and none"),
        pytest.param(("headset-check", "--host", "no such host"), "no such host", id="a host that cannot be bound"),
        pytest.param(("headset-check", "--duration", "inf"), "--duration inf", id="a check without end"),
        pytest.param(("check", "pyproject.toml"), "pyproject.toml", id="a file that is no cell"),
        pytest.param(
            ("check", CELL, "--pairs", "a.srdf", "--model-pairs", "."), "exclude each other", id="two kinds of pairs"
        ),
        pytest.param(("check", CELL, "--model-pairs", "nowhere"), "nowhere: no such folder", id="no folder"),
        pytest.param(("bench", "--ticks", "0"), "--ticks", id="a benchmark of nothing"),
        pytest.param(
            ("bench", "--work", "--motion", "dance"), "motion 'dance': allowed: carry-", id="an unknown motion"
        ),
        pytest.param(("bench", "--motion", "meet"), "needs --work", id="a motion of what times ticks"),
        pytest.param(("bench", "--work", "--ticks", "200"), "--ticks", id="ticks of motions that have a length"),
    ],
)
def test_bad_usage_ends_in_exit_code_2_and_one_line_that_names_it(arguments: tuple[str, ...], named: str) -> None:
    result = q2r2(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("q2r2: ")
    assert named in result.stderr


def changed_cell(folder: Path, old: str, new: str) -> str:
    text = find_resource(CELL).read_text(encoding="utf-8")
    assert old in text
    file = folder / "cell.yaml"
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    return str(file)


def test_check_prints_arms_limits_obstacles_and_the_nearest_pairs_of_a_good_cell() -> None:
    result = q2r2("check", CELL)
    assert result.exit_code == 0
    for expected in ("left_A1", "right_A7", "hand_e", "left_tool_frame", "table", "monitored pairs", "min_distance 20"):
        assert expected in result.stdout
    assert "FAULT" not in result.stdout


def external_cell(folder: Path, old: str = "mode: raw", new: str = "mode: raw") -> str:
    file = folder / "external.yaml"
    file.write_text(external_text().replace(old, new, 1), encoding="utf-8")
    return str(file)


@pytest.mark.parametrize(
    ("mode", "source"),
    [("raw", "the hand's target"), ("filtered", "what the built-in controller makes of the hand's target")],
)
def test_check_says_what_drives_the_arms_and_how(tmp_path: Path, mode: str, source: str) -> None:
    assert "arms driven by the built-in controller\n" in q2r2("check", CELL).stdout
    file = external_cell(tmp_path, new=f"mode: {mode}")
    topic = "/bh_robot/right_arm_clik_controller/target_frame"
    takes = "it takes: active; keeps the last target for ever"
    line = f"kuka_lbr_clik: PoseStamped in bh_robot_base on {topic} at 100 Hz, {source}; {takes}"
    assert f"right driven by {line}\n" in q2r2("check", file).stdout
    assert one_object(q2r2("check", file, "--json").stdout)["driven"]["right"] == line


def test_a_cell_with_an_external_controller_is_not_run_without_ros(tmp_path: Path) -> None:
    result = q2r2("run", external_cell(tmp_path), "--plant", "kinematic", "--fast", "--duration", "1", "--headless")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "q2r2: dual_iiwa7: controller: external is driven by q2r2 ros up; this command runs controller: builtin only\n"
    )


def test_check_as_json_has_limits_and_distances_in_order() -> None:
    cell = one_object(q2r2("check", CELL, "--json").stdout)
    assert [arm["name"] for arm in cell["arms"]] == ["left", "right"]
    joint = cell["arms"][0]["joints"][0]
    assert joint["name"] == "left_A1"
    assert joint["lower"] == pytest.approx(-2.967, abs=1e-3)
    assert joint["velocity"] == pytest.approx(1.71, abs=0.01)
    distances = [pair["distance"] for pair in cell["nearest"]]
    assert distances == sorted(distances)
    assert cell["monitored_pairs"] > len(distances) > 3
    assert cell["faults"] == []


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        pytest.param("home: [0.0204, 0.348,", "home: [0.0204, 1.0,", "left_hand_e_envelope_0 and table_0", id="table"),
        pytest.param("0.0204, 0.348,", "0.0204, 2.09,", "left_A2 = 2.09; allowed: -2.0844 .. 2.0844", id="limits"),
        pytest.param("floor: 0.0 ", "floor: 0.37 ", "left_hand_e_finger_1_envelope_0 and floor_0 are", id="floor"),
        pytest.param(
            "[0.0, 0.4, 0.0]", "[0.0, 0.4, -0.6]", "left_hand_e_finger_1_envelope_0 and floor_0 are", id="a low mount"
        ),
    ],
)
def test_check_lists_what_is_wrong_at_home_and_exits_with_1(tmp_path: Path, old: str, new: str, fault: str) -> None:
    file = changed_cell(tmp_path, old, new)
    result = q2r2("check", file)
    assert result.exit_code == 1
    assert f"FAULT home: {fault}" in result.stdout
    result = q2r2("check", file, "--json")
    assert result.exit_code == 1
    assert any(fault in line for line in one_object(result.stdout)["faults"])


def test_check_says_how_to_do_without_the_floor_that_is_in_the_way(tmp_path: Path) -> None:
    low = changed_cell(tmp_path, "[0.0, 0.4, 0.0]", "[0.0, 0.4, -0.6]")
    lines = [line for line in q2r2("check", low).stdout.splitlines() if line.startswith("FAULT") and "floor_0" in line]
    assert lines
    assert all(line.endswith("; the key floor takes another height, or null for no floor") for line in lines)
    text = Path(low).read_text(encoding="utf-8").replace("floor: 0.0 ", "floor: null ")
    Path(low).write_text(text.replace("position: [0.75, 0.0, 0.1]", "position: [0.75, 0.0, -0.6]"), encoding="utf-8")
    result = q2r2("check", low)
    assert (result.exit_code, "floor" in result.stdout) == (0, False)


def test_check_notes_where_a_stop_asks_for_more_torque_than_there_is_and_that_is_no_fault(tmp_path: Path) -> None:
    fast = changed_cell(tmp_path, "acceleration_limit: {} ", "acceleration_limit: {A1: 10.0, A2: 10.0, A3: 10.0} ")
    result = q2r2("check", fast)
    (note,) = (line for line in result.stdout.splitlines() if line.startswith("NOTE "))
    assert re.search(
        r"^NOTE left arm: .*left_A2 is asked for up to 1\.09 times its torque limit, at (-?\d\.\d\d ){7}rad\. "
        r"In 9\.\d % of 5000 random postures \(seed 0\) .*; with 0\.86 times these limits, in none of them: "
        r"arms\.left\.acceleration_limit, control\.acceleration_limit$",
        note,
    )
    assert result.exit_code == 0
    cell = one_object(q2r2("check", fast, "--json").stdout)
    assert [f"NOTE {note}" for note in cell["notes"]] == [note]
    assert cell["stop_torques"][0]["stop"]["share_over"] > 0.09
    assert cell["stop_torques"][1]["stop"]["share_over"] == 0.0


def test_check_shows_for_each_joint_what_gravity_and_a_full_stop_ask_of_it() -> None:
    cell = one_object(q2r2("check", CELL, "--json").stdout)
    assert cell["notes"] == []
    joint, other = (cell["stop_torques"][1]["joints"][index] for index in (1, 3))
    assert (joint["joint"], joint["acceleration"]) == ("right_A2", 5.44)
    assert other["acceleration"] == 10.0, "the smaller one of the joint's and control.acceleration_limit"
    assert 0.0 < joint["gravity"] < joint["stop"] < 1.0


@pytest.mark.parametrize("command", ["check", "run", "headset-check"])
def test_a_wrong_key_ends_in_one_line_that_names_file_key_and_what_is_allowed(tmp_path: Path, command: str) -> None:
    result = q2r2(command, changed_cell(tmp_path, "obstacles:", "obstructions:"))
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "cell.yaml: obstructions" in result.stderr
    assert "obstacles" in result.stderr


def test_a_fast_run_prints_one_json_object_with_every_figure_and_nothing_else_and_repeats_itself() -> None:
    arguments = (*FAST, "--duration", "2.5", "--human", "--seed", "7", "--trajectory", "circle")
    first, second = q2r2(*arguments), q2r2(*arguments)
    assert first.exit_code == second.exit_code == 0
    summaries = [one_object(result.stdout) for result in (first, second)]
    assert summaries[0].keys() >= SUMMARY_KEYS
    assert all(arm.keys() >= ARM_KEYS for arm in summaries[0]["arms"].values())
    assert summaries[0]["tick_us"].keys() == {"p50", "p99", "max"}
    assert summaries[0]["arms"]["left"]["engaged_s"] > 1.0
    assert summaries[0]["events"][0].keys() == {"t", "arm", "from", "to", "kind", "detail", "reason"}
    for summary in summaries:
        for timing in ("tick_us", "loop_rate_hz"):
            del summary[timing]
    assert summaries[0] == summaries[1]


@pytest.mark.slow
def test_a_run_by_torque_repeats_itself_too_and_differs_from_one_by_position() -> None:
    arguments = ("run", CELL, "--fast", "--json", "--headless", "--trajectory", "circle", "--duration", "1.8")
    runs = [q2r2(*arguments, "--mode", mode) for mode in ("torque", "torque", "position")]
    errors = [one_object(run.stdout)["arms"]["left"]["position_error_mm_rms"] for run in runs]
    assert errors[0] == errors[1] != errors[2]
    assert 0.0 < errors[0] < 2.0


def test_without_json_a_run_ends_with_a_readable_summary() -> None:
    result = q2r2(*FAST[:5], "--duration", "0.2")
    assert result.exit_code == 0
    for expected in ("left arm", "nearest pair", "input to command", "at rest"):
        assert expected in result.stdout


@pytest.mark.slow
def test_the_demo_leaves_a_picture_and_the_summary_in_a_folder_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = q2r2("demo", "--duration", "0.5", "--headless", "--json")
    assert result.exit_code == 1, "no task is done so early"
    path = next(line.removeprefix("report: ") for line in result.stderr.splitlines() if line.startswith("report: "))
    assert Path(path).read_bytes().startswith(b"\x89PNG")
    assert Path(path).parent.parent == Path("runs")
    assert json.loads(Path(path).with_name("summary.json").read_text()) == one_object(result.stdout)


@pytest.mark.slow
def test_the_demo_says_of_each_task_whether_it_succeeded_and_so_does_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse = load_config(CELL).model_copy(update={"loop_rate_hz": 200.0})
    monkeypatch.setattr("q2r2_control.cli.demo.load_config", lambda path: coarse)
    monkeypatch.chdir(tmp_path)
    demo = ("demo", "grasp", "--fast", "--headless", "--mode", "position")
    done = q2r2(*demo)
    assert done.exit_code == 0
    assert "grasp succeeded (lifted 10" in done.stdout
    early = q2r2(*demo, "--duration", "4", "--json")
    assert early.exit_code == 1
    (task,) = one_object(early.stdout)["tasks"]
    assert (task["name"], task["succeeded"]) == ("grasp", False)
    assert task["reason"].startswith("flat_block: held 95 mm up for 0.0 s")


@pytest.mark.slow
def test_headset_check_shows_a_headset_in_a_process_of_its_own() -> None:
    with process("headset-check", "--port", "0", "--json") as running:
        fake_headset(bound_port(running), 1.5)
        running.send_signal(signal.SIGINT)
        stdout, _ = running.communicate(timeout=30)
    assert running.returncode == 0
    check = one_object(stdout)
    assert check["dialect"] == "ROS2"
    assert check["connections"] == 1
    assert check["last_disconnect"] == "closed by the headset"
    assert set(check["topics"]) == {
        f"q2r_{hand}_hand_{kind}" for hand in ("left", "right") for kind in ("pose", "inputs")
    }
    assert check["topics"]["q2r_left_hand_pose"]["count"] == 112


def test_headset_check_of_a_headset_without_buttons_says_so_and_fails() -> None:
    with (
        process("headset-check", "--port", "0", "--json") as running,
        FakeHeadset(("127.0.0.1", bound_port(running))) as headset,
    ):
        headset.send(headset.pose("left", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, -1.0)) + headset.registrations())
        headset.read_until("__topic_list")
        running.send_signal(signal.SIGINT)
        stdout, _ = running.communicate(timeout=30)
    assert running.returncode == 1
    check = one_object(stdout)
    assert "q2r_left_hand_inputs" in check["missing"]
    assert "left hand: no inputs" in "\n".join(check["advice"])


def test_a_headset_server_on_every_network_says_what_to_enter_in_the_app_and_who_can_drive() -> None:
    result = q2r2("headset-check", "--host", "0.0.0.0", "--port", "0", "--duration", "0.1", "--json")
    port = one_object(result.stdout)["address"][1]
    listening, enter, drivers = result.stderr.splitlines()[:3]
    assert listening == f"headset: listening on 0.0.0.0:{port}"
    assert re.fullmatch(rf"headset: enter in the app: address .+, port {port}, protocol ROS2", enter)
    assert drivers.startswith("headset: whoever reaches this port can drive the arms; headset.allow")


def test_a_host_outside_the_cells_headset_allow_is_refused(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(Path(CELL).read_text(encoding="utf-8").replace("allow: null", "allow: [10.0.0.0/8]"), "utf-8")
    with process("headset-check", str(cell), "--host", "0.0.0.0", "--port", "0", "--json") as running:
        with FakeHeadset(("127.0.0.1", bound_port(running))) as headset:
            assert b"127.0.0.1 is not in headset.allow" in headset.read_until("__error")
        running.send_signal(signal.SIGINT)
        assert running.stderr is not None
        stderr = running.stderr.read()  # with what was read ahead behind the line of the address
    assert "only 10.0.0.0/8 can drive the arms" in stderr


def test_headset_check_says_what_to_look_at_when_nothing_comes() -> None:
    result = q2r2("headset-check", "--port", "0", "--duration", "2.3", "--json")
    assert result.exit_code == 1
    advice = "\n".join(one_object(result.stdout)["advice"])
    address = "{}:{}".format(*one_object(result.stdout)["address"])
    for expected in (address, "--host 0.0.0.0", "firewall", "network", "ROS2"):
        assert expected in advice
        assert expected in result.stderr


@pytest.mark.slow
def test_ctrl_c_brings_the_arms_to_rest_and_ends_a_headset_run_with_its_summary() -> None:
    arguments = ("--input", "headset", "--port", "0", "--plant", "kinematic", "--headless", "--json")
    with process("run", CELL, *arguments) as running:
        fake_headset(bound_port(running), 2.0)
        running.send_signal(signal.SIGINT)
        stdout, stderr = running.communicate(timeout=30)
    assert running.returncode == 0, stderr
    summary = one_object(stdout)
    assert summary["at_rest"]
    assert summary["arms"]["left"]["engaged_s"] > 0.5
    assert "connection_lost" in [event["kind"] for event in summary["events"]]


@pytest.mark.slow
def test_bench_times_every_scenario() -> None:
    report = one_object(q2r2("bench", "--no-peers", "--ticks", "100", "--json").stdout)
    assert {row["ticks"] for row in report["rows"]} == {100}
    assert all(0.0 < row["median_us"] <= row["p99_us"] <= row["max_us"] for row in report["rows"])
    assert all(row["min_distance_mm"] >= 20.0 for row in report["rows"])
    table = q2r2("bench", "--no-peers", "--ticks", "100").stdout
    assert all(row["name"] in table for row in report["rows"])


@pytest.mark.slow
def test_bench_measures_the_work_motions_that_are_asked_for() -> None:
    result = q2r2("bench", "--work", "--no-peers", "--motion", "slide", "--motion", "reach", "--json")
    report = one_object(result.stdout)
    assert [row["motion"] for row in report["rows"]] == ["reach-under", "slide"]
    least = [figures["min_distance_mm"] for row in report["rows"] for figures in row["figures"]]
    assert min(least) >= 1.0, "what fingers keep from the table"
    table = q2r2("bench", "--work", "--no-peers", "--motion", "slide").stdout
    assert "slide (!)" in table
    assert "q2r2_control" in table


def test_a_soak_prints_every_promise_and_ends_in_0_when_all_were_kept() -> None:
    result = q2r2("soak", "--ticks", "400", "--seed", "1", "--json")
    report = one_object(result.stdout)
    assert report["passed"]
    assert result.exit_code == 0
    assert report["ticks"] == 400
    assert {margin["violations"] for margin in report["margins"]} == {0}
    table = q2r2("soak", "--ticks", "100").stdout
    assert "acceleration / limit" in table


def test_a_soak_that_finds_something_ends_in_1(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: Any) -> SoakReport:
        report = run_soak(*arguments)
        report.margins[0].note(1.0, 7)
        return report

    monkeypatch.setattr("q2r2_control.cli.soak.run_soak", broken)
    result = q2r2("soak", "--ticks", "100", "--json")
    assert result.exit_code == 1
    assert not one_object(result.stdout)["passed"]


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--pairs", "--model-pairs"])
def test_a_search_for_pairs_says_how_far_it_has_got(
    tmp_path: Path, option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("q2r2_control.cli.check.ProgressLines", partial(ProgressLines, period=0.0))
    target = tmp_path if option == "--model-pairs" else tmp_path / "cell.srdf"
    result = q2r2("check", CELL, option, str(target), "--samples", "300")
    assert result.exit_code == 0
    assert " of 300\n" in result.stderr
