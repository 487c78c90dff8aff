"""``q2r2 ros up``: processes that start together, are reported when they end, and end together."""

from __future__ import annotations

import itertools
import os
import runpy
import signal
import sys
import time
import tomllib
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from q2r2_control.ros.launch import executables
from q2r2_control.ros.launch.processes import NO_INPUT, NodeProcess, nodes_of
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, PATIENCE, ROOT, Processes, RosProcess
from tests.support.external_cell import external
from tests.support.processes import alive, children

need_ros()
pytestmark = pytest.mark.alone

# Two programs instead of nodes, through the same function as the command.
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


def test_a_process_that_dies_is_reported_and_ends_the_others(pair: RosProcess) -> None:
    first, second = children(pair.pid)
    os.kill(first, signal.SIGKILL)
    assert f"first (process {first}) was ended by SIGKILL" in pair.wait_for("[up] ")
    assert pair.wait(30.0) == 1
    assert not alive(second)


def test_a_process_that_does_not_end_is_killed(pair: RosProcess) -> None:
    _, second = children(pair.pid)
    os.kill(second, signal.SIGSTOP)
    assert pair.interrupt(30.0) == 0
    assert f"second (process {second}) did not end and is killed" in pair.output
    assert not alive(second)


def test_a_set_whose_command_is_killed_ends_by_itself(pair: RosProcess) -> None:
    started = children(pair.pid)
    os.kill(pair.pid, signal.SIGKILL)
    deadline = time.monotonic() + PATIENCE
    while any(map(alive, started)):
        assert time.monotonic() < deadline, "a program has outlived the command"
        time.sleep(0.05)


def test_the_command_starts_and_stops_the_whole_set(processes: Processes) -> None:
    nodes = nodes_of(CONFIG, "scripted")
    process = processes.start(sys.executable, "-m", "q2r2_control", "ros", "up", CONFIG, name="up")
    for name in ("mujoco_robot", "cartesian_controller"):
        process.wait_for(f"[{name}] ")
    process.wait_for("active: ")
    started = children(process.pid)
    assert len(started) == len(nodes) == 4
    assert process.interrupt(60.0) == 0
    assert not any(map(alive, started))


def external_cell(folder: Path, preset: str, mode: str, **changes: Any) -> str:
    cell = external()
    cell["external"] |= {"preset": preset, "mode": mode} | changes
    file = folder / "external.yaml"
    file.write_text(yaml.safe_dump(cell))
    return str(file)


def names(nodes: Sequence[NodeProcess]) -> list[str]:
    return [node.name for node in nodes]


TOGETHER = ["arm_controllers"]
SEPARATE = ["left_arm_controller", "right_arm_controller"]


def test_controllers_that_take_the_hands_target_need_no_other(tmp_path: Path) -> None:
    file = external_cell(tmp_path, "fzi", "raw")
    assert names(nodes_of(file, "headset")) == [*TOGETHER, "tcp_endpoint"]
    assert names(nodes_of(file, "none", "mujoco")) == ["mujoco_robot", *TOGETHER]
    assert all(node.parameters == {"config": file} for node in nodes_of(file, "none"))


def test_controllers_that_take_what_the_built_in_one_allows_get_it_without_joint_commands(tmp_path: Path) -> None:
    file = external_cell(tmp_path, "fzi", "filtered", world_frame="cell")
    nodes = nodes_of(file)
    assert names(nodes) == ["cartesian_controller", *TOGETHER, "SimulationInput"]
    assert nodes[0].parameters == {
        "config": file,
        "output": "none",
        "left.target_frame_id": "cell",
        "left.joint_states_topic": "joint_states",
        "right.target_frame_id": "cell",
        "right.joint_states_topic": "joint_states",
    }


def test_controllers_of_joints_get_them_from_the_built_in_one_each_on_its_topic(tmp_path: Path) -> None:
    file = external_cell(tmp_path, "lbr_position", "filtered")
    parameters = nodes_of(file)[0].parameters
    assert (parameters["output"], parameters["rate"]) == ("lbr_position", 200.0)
    for arm in ("left", "right"):
        assert parameters[f"{arm}.output_topic"] == f"/bh_robot/{arm}_arm_clik_controller/command/joint_position"
        assert parameters[f"{arm}.target_frame_id"] == "bh_robot_base"


def test_arms_have_a_process_each_where_that_is_asked_for() -> None:
    assert names(nodes_of(CONFIG, "none"))[2:] == TOGETHER
    assert names(nodes_of(CONFIG, "none", separate=True))[2:] == SEPARATE


def test_a_cell_with_one_arm_has_one_arms_nodes(tmp_path: Path) -> None:
    cell = external() | {"controller": "builtin"}
    del cell["external"], cell["arms"]["right"]
    file = tmp_path / "one.yaml"
    file.write_text(yaml.safe_dump(cell))
    assert names(nodes_of(str(file), "none")) == ["mujoco_robot", "cartesian_controller", "left_arm_controller"]


def test_every_node_of_a_set_is_an_executable(tmp_path: Path) -> None:
    scripts: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for source in ("scripted", "headset", NO_INPUT):
        sets = (nodes_of(CONFIG, source, "mujoco", {"folder": "recordings"}, separate) for separate in (True, False))
        for node in itertools.chain(*sets):
            module, _, function = scripts[node.name].partition(":")
            assert module == executables.__name__
            assert node.name in executables.NODES
            assert callable(getattr(executables, function))


class Recorded:
    """Stands for a class of launch: keeps what it was made with. Whether launch takes that, only launch can tell."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named

    def perform(self, context: dict[str, str]) -> str:
        return context[self.given[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The launch file with launch's classes recorded, since launch itself is not in the Python registry."""
    for module, classes in {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction", "Shutdown"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
    }.items():
        made = types.ModuleType(module)
        for name in classes:
            setattr(made, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    return runpy.run_path(str(ROOT / "launch" / "teleop.launch.py"))


@pytest.mark.parametrize(
    ("preset", "source", "folder", "separate"),
    [("builtin", "headset", "recordings", "true"), ("jtc", "none", "", "false")],
)
def test_the_launch_file_starts_what_the_command_starts(
    launch_file: Any, tmp_path: Path, preset: str, source: str, folder: str, separate: str
) -> None:
    config = CONFIG if preset == "builtin" else external_cell(tmp_path, preset, "filtered")
    *arguments, nodes = launch_file["generate_launch_description"]().given[0]
    given = {argument.given[0]: argument.named["default_value"] for argument in arguments}
    given |= {"config": config, "input": source, "record": folder, "separate": separate}
    actions = nodes.named["function"](given)
    recording = {"folder": folder} if folder else None
    expected = nodes_of(config, source, separate=separate == "true", recording=recording)
    assert [(action.named["package"], action.named["executable"]) for action in actions] == [
        ("q2r2_control", node.name) for node in expected
    ]
    for action, node in zip(actions, expected, strict=True):
        (parameters,) = action.named["parameters"]
        assert {key: value.given[0] for key, value in parameters.items()} == node.parameters
        assert all(isinstance(value.given[0], value.named["value_type"]) for value in parameters.values())
        assert action.named["on_exit"].named == {"reason": f"{node.name} ended"}
