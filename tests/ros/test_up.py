"""``q2r2 ros up``: processes that start together, are reported when they end, and end together."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import signal
import sys
import tomllib
from typing import Any

import pytest

from q2r2_control.ros.up import nodes_of
from tests.ros.cell import CONFIG
from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import ROOT, Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytestmark = pytest.mark.usefixtures("interfaces")

# The robot and the controller alone, through the same functions as the command.
PAIR = f"""
import sys
from q2r2_control.ros.up import nodes_of, run_together
sys.exit(run_together(nodes_of({CONFIG!r}, "none")[:2], lambda line: print(line, flush=True)))
"""


@pytest.fixture
def pair(processes: Processes) -> RosProcess:
    process = processes.start(sys.executable, "-c", PAIR, name="up")
    process.wait_for("[cartesian_controller] ")
    process.wait_for("active: ")
    return process


def children(pid: int) -> list[int]:
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        return [int(child) for child in file.read().split()]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_ctrl_c_ends_every_process(pair: RosProcess) -> None:
    started = children(pair.pid)
    assert len(started) == 2
    assert pair.interrupt(30.0) == 0
    assert not any(map(alive, started))
    assert "[mujoco_robot] " in pair.output
    assert "[up] all stopped" in pair.output


def test_a_process_that_dies_is_reported_and_ends_the_others(pair: RosProcess) -> None:
    robot, controller = children(pair.pid)
    os.kill(robot, signal.SIGKILL)
    assert f"mujoco_robot (process {robot}) ended by SIGKILL" in pair.wait_for("[up] ")
    assert pair.wait(30.0) == 1
    assert not alive(controller)


def test_the_command_starts_and_stops_the_whole_set(processes: Processes) -> None:
    nodes = nodes_of(CONFIG, "scripted")
    process = processes.start(sys.executable, "-m", "q2r2_control", "ros", "up", CONFIG, name="up")
    for name in ("mujoco_robot", "cartesian_controller"):
        process.wait_for(f"[{name}] ")
    process.wait_for("active: ")
    started = children(process.pid)
    assert len(started) == len(nodes) == 5
    assert process.interrupt(60.0) == 0
    assert not any(map(alive, started))


def test_a_config_that_does_not_exist_ends_in_one_line(processes: Processes) -> None:
    process = processes.start(sys.executable, "-m", "q2r2_control", "ros", "up", "nowhere.yaml", name="up")
    assert process.wait() == 2
    (line,) = process.output.splitlines()
    assert "nowhere.yaml" in line


def test_the_launch_file_names_what_the_command_starts_and_what_is_installed() -> None:
    tree = ast.parse((ROOT / "launch" / "teleop.launch.py").read_text())
    compile(tree, "teleop.launch.py", "exec")
    (nodes,) = (
        ast.literal_eval(statement.value)
        for statement in tree.body
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "NODES"
    )
    by_input = {
        source: {name for name, wanted in nodes if wanted in (None, source)}
        for source in ("scripted", "headset", "none")
    }
    assert by_input == {source: {node.name for node in nodes_of(CONFIG, source)} for source in by_input}
    scripts: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for node in (node for source in by_input for node in nodes_of(CONFIG, source)):
        if importlib.util.find_spec(node.module) is not None:  # a node that is there is an executable
            assert re.fullmatch(rf"{re.escape(node.module)}:main", scripts[node.name])
