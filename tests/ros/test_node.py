"""What all nodes tell of themselves, whatever the time does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tomllib
from typing import Any

import pytest

from q2r2_control.ros.launch.executables import NODES
from tests.ros.conftest import need_ros
from tests.ros.processes import ROOT, Processes
from tests.ros.waiting import States

need_ros()


def test_all_threads_of_a_node_that_ticks_have_its_real_time_priority_where_it_is_permitted(
    node: Any, processes: Processes
) -> None:
    wanted = 7
    if sys.platform != "linux":
        pytest.skip("only Linux has SCHED_FIFO")
    states = States(node, "simulation_input")
    process = processes.start_node("SimulationInput", f"realtime_priority:={wanted}")
    states.wait_for("waits for a subscriber")
    refused = "no SCHED_FIFO" in process.output
    expected = (0, 0) if refused else (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, wanted)
    # The thread that ticks, and those of the middleware that were there before: others may have begun since.
    threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
    found = [(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in sorted(threads)]
    assert found[0] == expected
    assert found.count(expected) > 1


# Runs an entry point and presses Ctrl-C when a module is about to be imported.
RUN = """
import os, signal, sys
from importlib import import_module

class Interrupter:
    def find_spec(self, name, path=None, target=None):
        if name == {at!r}:
            os.kill(os.getpid(), signal.SIGINT)

module, _, function = {entry!r}.partition(":")
sys.meta_path.insert(0, Interrupter())
getattr(import_module(module), function)()
"""
SCRIPTS: dict[str, str] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", ["q2r2", "arm_controllers", "mujoco_robot"])
def test_ctrl_c_while_importing_ends_a_command_and_prints_nothing(name: str) -> None:
    at = f"q2r2_control.ros.nodes.{NODES[name][0]}" if name in NODES else "q2r2_control.cli.app"
    code = RUN.format(at=at, entry=SCRIPTS[name])
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (run.stdout, run.stderr) == ("", "")
    assert run.returncode == -signal.SIGINT


def test_ctrl_c_before_the_interpreter_has_started_waits_for_the_executable_of_a_set() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "q2r2_control.ros.launch.executables", "mujoco_robot"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}),
    )
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert (output, process.returncode) == ("", -signal.SIGINT)
