"""``q2r2 ros up`` starts processes together, reports their ends, and ends them together."""

from __future__ import annotations

import os
import re
import runpy
import signal
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

from q2r2_control import Robot, extras
from q2r2_control.errors import NOT_RECORDED, MissingPackageError
from q2r2_control.ros.launch import executables
from q2r2_control.ros.launch.processes import NO_INPUT, NodeProcess, nodes_of, run_together
from q2r2_control.types import SIDES
from tests.cli.command import q2r2
from tests.ros.cell import JointRecorder
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, ROOT, Processes, RosProcess, wait_until
from tests.support.external_cell import external
from tests.support.processes import alive, children

need_ros()
pytestmark = pytest.mark.alone

# This script runs two programs instead of nodes, by the function that the command uses.
PROGRAM = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
print("ready", flush=True)
time.sleep(60.0)
"""
PAIR = f"""
import sys
from q2r2_control.ros.launch.processes import NodeProcess, run_together

class Program(NodeProcess):
    def command(self):
        return [sys.executable, "-c", {PROGRAM!r}]

programs = [Program(name) for name in ("first", "second")]
sys.exit(run_together(programs, lambda line: print(line, flush=True)))
"""


@pytest.fixture
def pair(processes: Processes) -> RosProcess:
    process = processes.start(sys.executable, "-c", PAIR, name="up")
    for name in ("first", "second"):
        process.wait_for(f"[{name}] ready")
    return process


def test_if_one_process_dies_its_end_is_reported_and_all_other_processes_are_ended(pair: RosProcess) -> None:
    first, second = children(pair.pid)
    os.kill(first, signal.SIGKILL)
    assert f"first (process {first}) was ended by SIGKILL" in pair.wait_for("[up] ")
    assert pair.wait(30.0) == 1
    assert not alive(second)


def test_a_set_whose_recording_failed_has_its_own_exit_code(processes: Processes) -> None:
    process = processes.start(sys.executable, "-c", PAIR.replace("sys.exit(0)", f"sys.exit({NOT_RECORDED})"), name="up")
    for name in ("first", "second"):
        process.wait_for(f"[{name}] ready")
    assert process.interrupt(30.0) == NOT_RECORDED
    assert "all stopped, but the recording of first failed" in process.output


def test_a_process_that_does_not_end_is_killed(pair: RosProcess) -> None:
    _, second = children(pair.pid)
    os.kill(second, signal.SIGSTOP)
    assert pair.interrupt(30.0) == 0
    assert f"second (process {second}) did not end and is killed" in pair.output
    assert not alive(second)


@pytest.mark.parametrize(("node", "extra"), [("mujoco_robot", "sim"), ("recorder", "data")])
def test_a_set_without_the_extra_of_a_node_names_it_before_any_node_starts(
    monkeypatch: pytest.MonkeyPatch, node: str, extra: str
) -> None:
    monkeypatch.setattr(extras, "_is_installed", lambda module: False)
    monkeypatch.setattr("q2r2_control.ros.launch.processes.build_missing", lambda say: pytest.fail("nodes would start"))
    with pytest.raises(MissingPackageError, match=rf"^{node} needs .*\[{extra}\]'$"):
        run_together([NodeProcess(node, {})], print)


def test_a_set_whose_command_is_killed_ends_by_itself(pair: RosProcess) -> None:
    started = children(pair.pid)
    os.kill(pair.pid, signal.SIGKILL)
    wait_until(lambda: not any(map(alive, started)), "no program outlives the command")


def test_the_command_in_the_readme_moves_both_arms_and_stops(node: Any, robot: Robot, processes: Processes) -> None:
    command = re.search(r"`q2r2 (ros up \S+ --input scripted)`", (ROOT / "README.md").read_text())
    assert command is not None
    joints = JointRecorder(node, robot)
    up = processes.start(sys.executable, "-u", "-m", "q2r2_control", *command[1].split(), name="up")
    wait_until(lambda: joints.states, "joint states come")
    home = joints.q
    arms = robot.arms.values()
    wait_until(lambda: all(np.abs(joints.q - home)[arm.joints].max() > 0.05 for arm in arms), "both arms move")
    # The line has the node's name once, and neither its process's name nor a time.
    assert re.match(r"\[(left|right)_q2r2_arm_controller\] INFO: engaged", up.wait_for("engaged: lower button"))
    started = children(up.pid)
    assert len(started) == len(nodes_of(CONFIG, "scripted")) == 4
    assert up.interrupt(60.0) == 0
    assert not any(map(alive, started))


def external_cell(folder: Path, preset: str, mode: str, **changes: Any) -> str:
    cell = external()
    cell["external"] |= {"preset": preset, "mode": mode} | changes
    file = folder / "external.yaml"
    file.write_text(yaml.safe_dump(cell))
    return str(file)


def names(nodes: Sequence[NodeProcess]) -> list[str]:
    return [node.name for node in nodes]


def test_a_set_has_the_controller_that_its_preset_needs_with_the_topics_and_frames_of_the_cell(tmp_path: Path) -> None:
    file = external_cell(tmp_path, "fzi", "raw")
    assert names(nodes_of(file, "headset")) == ["arm_controllers", "tcp_endpoint"]
    assert names(nodes_of(file, "none", "mujoco")) == ["mujoco_robot", "arm_controllers"]
    assert all(node.parameters == {"config": file} for node in nodes_of(file, "none"))

    nodes = nodes_of(external_cell(tmp_path, "fzi", "filtered", world_frame="cell"))
    assert names(nodes) == ["cartesian_controller", "arm_controllers", "SimulationInput"]
    each = {"target_frame_id": "cell", "joint_states_topic": "joint_states"}
    per_arm = {f"{arm}.{name}": value for arm in SIDES for name, value in each.items()}
    assert nodes[0].parameters == {"config": file, "output": "none", **per_arm}

    arms = external()["external"]["arms"]
    for arm in SIDES:
        arms[arm]["ctrl_prefix"] = f"/{arm}/lbr_joint_position_command_controller"
    parameters = nodes_of(external_cell(tmp_path, "lbr_position", "filtered", arms=arms))[0].parameters
    assert (parameters["output"], parameters["rate"]) == ("lbr_position", 200.0)
    for arm in SIDES:
        assert parameters[f"{arm}.output_topic"] == f"/{arm}/command/lbr_joint_position_command"
        assert parameters[f"{arm}.target_frame_id"] == "bh_robot_base"


def test_ros_up_starts_the_recorder_before_the_other_nodes_and_the_page_after_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="the extra web brings it")
    monkeypatch.chdir(tmp_path)  # The folder of recordings is made here.
    started: list[NodeProcess] = []

    def start(nodes: list[NodeProcess], say: object) -> int:
        started.extend(nodes)
        return 0

    monkeypatch.setattr("q2r2_control.cli.ros.run_together", start)
    command = f"ros up {CONFIG} --input scripted --record DIR --web --web-port 0"
    assert q2r2(*command.split()).exit_code == 0
    assert names(started) == [
        *("recorder", "mujoco_robot", "cartesian_controller", "arm_controllers", "SimulationInput", "web_page")
    ]
    assert started[0].parameters == {"config": CONFIG, "folder": "DIR"}
    assert started[-1].parameters["web_port"] == 0
    assert started[-1].parameters["recorded"]
    started.clear()
    assert q2r2(*f"ros up {CONFIG} --input scripted --record DIR --operator Ada --anonymous".split()).exit_code == 0
    assert started[0].parameters == {"config": CONFIG, "folder": "DIR", "operator": "Ada", "anonymous": True}
    assert "--anonymous needs --record" in q2r2(*f"ros up {CONFIG} --anonymous".split()).stderr


def test_arguments_for_ros_reach_every_node(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[NodeProcess] = []

    def start(nodes: list[NodeProcess], say: object) -> int:
        started.extend(nodes)
        return 0

    monkeypatch.setattr("q2r2_control.cli.ros.run_together", start)
    command = f"ros up --namespace cell/left --sim-time {CONFIG} --ros-args -r tf:=/tf -p rate:=125.0 -- --input none"
    assert q2r2(*command.split()).exit_code == 0
    assert names(started) == ["mujoco_robot", "cartesian_controller", "arm_controllers"]
    given = ["-r", "__ns:=/cell/left", "-p", "use_sim_time:=true", "-r", "tf:=/tf", "-p", "rate:=125.0"]
    assert all(node.command()[-len(given) :] == given for node in started)
    refused = q2r2("ros", "up", CONFIG, "--namespace", "no name")
    assert (refused.exit_code, refused.stderr) == (
        2,
        "q2r2: --namespace = 'no name': allowed is a ROS name such as /cell\n",
    )


def test_each_arm_has_its_own_process_on_request_or_if_the_cell_has_only_one_arm(tmp_path: Path) -> None:
    assert names(nodes_of(CONFIG, "none"))[2:] == ["arm_controllers"]
    assert names(nodes_of(CONFIG, "none", separate=True))[2:] == ["left_arm_controller", "right_arm_controller"]
    cell = external() | {"controller": "builtin"}
    del cell["external"], cell["arms"]["right"]
    (file := tmp_path / "one.yaml").write_text(yaml.safe_dump(cell))
    assert names(nodes_of(str(file), "none")) == ["mujoco_robot", "cartesian_controller", "left_arm_controller"]


@pytest.mark.parametrize(("stance", "hand"), [("side_by_side", "right"), ("mirror", "left")])
def test_in_a_cell_with_one_arm_a_scripted_input_has_only_the_hand_that_moves_this_arm(
    tmp_path: Path, stance: str, hand: str
) -> None:
    cell = yaml.safe_load((ROOT / "config" / "iiwa7.yaml").read_text())
    assert list(cell["arms"]) == ["right"]
    cell.setdefault("teleop", {})["stance"] = stance
    (file := tmp_path / "one.yaml").write_text(yaml.safe_dump(cell))
    assert nodes_of(str(file), "scripted")[-1].parameters["side"] == hand
    assert "side" not in nodes_of(CONFIG, "scripted")[-1].parameters


def test_every_node_of_a_set_is_an_executable(tmp_path: Path) -> None:
    scripts: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for source in ("scripted", "headset", NO_INPUT):
        more = {"folder": "recordings"}, True, ("127.0.0.1", 8080)
        for node in [*nodes_of(CONFIG, source, "mujoco", *more), *nodes_of(CONFIG, source)]:
            module, _, function = scripts[node.name].partition(":")
            assert module == executables.__name__
            assert node.name in executables.NODES
            assert callable(getattr(executables, function))


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A replacement for the package launch, which is not on PyPI. It keeps the arguments of launch's classes."""
    made = MagicMock()
    made.LaunchConfiguration = lambda name: SimpleNamespace(perform=lambda context: context[name])
    made.ParameterValue = lambda value, value_type: (value, value_type)
    parts = ("launch", "launch.actions", "launch.substitutions", "launch_ros", "launch_ros.actions")
    for module in (*parts, "launch_ros.parameter_descriptions"):
        monkeypatch.setitem(sys.modules, module, made)
    return made


@pytest.mark.parametrize(
    ("preset", "source", "folder", "separate"),
    [("builtin", "headset", "recordings", "true"), ("jtc", "none", "", "false")],
)
def test_the_launch_file_starts_the_same_nodes_as_the_command(
    launch: Any, tmp_path: Path, preset: str, source: str, folder: str, separate: str
) -> None:
    config = CONFIG if preset == "builtin" else external_cell(tmp_path, preset, "filtered")
    runpy.run_path(str(ROOT / "launch" / "teleop.launch.py"))["generate_launch_description"]()
    given = {call.args[0]: call.kwargs["default_value"] for call in launch.DeclareLaunchArgument.call_args_list}
    given |= {"config": config, "input": source, "record": folder, "separate": separate}
    given |= {"namespace": "/cell", "use_sim_time": "true"}
    launch.OpaqueFunction.call_args.kwargs["function"](given)
    recording = {"folder": folder} if folder else None
    expected = nodes_of(config, source, separate=separate == "true", recording=recording)
    actions = [call.kwargs for call in launch.Node.call_args_list]
    for action, node in zip(actions, expected, strict=True):
        assert (action["package"], action["executable"]) == ("q2r2_control", node.name)
        parameters, of_all = action["parameters"]
        assert (action["namespace"], of_all) == ("/cell", {"use_sim_time": True})
        assert parameters == {key: (value, type(value)) for key, value in node.parameters.items()}
    ends = [call.kwargs for call in launch.Shutdown.call_args_list]
    assert ends == [{"reason": f"{node.name} ended"} for node in expected]
