"""Tasks of the demo are tried with scripted hands that tremble, differently for each seed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from q2r2_control.demo.assembly_tasks import tasks_named
from q2r2_control.demo.trials import TrialReport, try_task, try_tasks
from q2r2_control.process.places import Processes
from q2r2_control.types import CommandMode
from tests.demo.test_assembly_tasks import coarse
from tests.support.processes import alive, children, wait_until


@pytest.mark.slow
def test_every_seed_is_tried_and_failed_seeds_have_reasons() -> None:
    config = coarse()
    trial = partial(try_task, config, CommandMode.POSITION, False)
    (report,) = try_tasks(tasks_named(["grasp"]), trial, 2, Processes(2))
    assert report == TrialReport("grasp", 2, {})
    block = config.mujoco.objects["flat_block"]
    elsewhere = block.model_copy(update={"position": (0.45, -0.40, block.position[2])})
    objects = {**config.mujoco.objects, "flat_block": elsewhere}
    moved = config.model_copy(update={"mujoco": config.mujoco.model_copy(update={"objects": objects})})
    assert "flat_block: held 95 mm up for 0.0 s" in try_task(moved, CommandMode.POSITION, False, ("grasp", 0))


@pytest.mark.slow
def test_arms_in_torque_mode_do_a_task_although_the_hands_tremble_and_are_lost_for_a_second() -> None:
    assert try_task(coarse(CommandMode.TORQUE), CommandMode.TORQUE, True, ("grasp", 0)) == ""


@pytest.fixture
def demo() -> Iterator[subprocess.Popen[str]]:
    """Start a demo that tries a task twice."""
    if sys.platform != "linux":
        pytest.skip("looks into /proc")
    command = (sys.executable, "-m", "q2r2_control", "demo", "grasp", "--seeds", "2")
    # A background job of a shell ignores SIGINT, and its children inherit this.
    listen = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=listen)
    try:
        yield demo
    finally:
        demo.kill()
        demo.wait()


def trials_of(demo: subprocess.Popen[str]) -> list[int]:
    """Return the processes of the demo that have begun a trial."""
    trials = []
    for pid, folder in ((pid, Path(f"/proc/{pid}")) for pid in children(demo.pid)):
        with suppress(OSError):  # Some processes end before this line, for example commands that a library calls.
            if b"spawn_main" in (folder / "cmdline").read_bytes() and "libmujoco" in (folder / "maps").read_text():
                trials.append(pid)
    return trials


@pytest.mark.slow
def test_ctrl_c_does_not_wait_for_trials(demo: subprocess.Popen[str]) -> None:
    wait_until(lambda: trials_of(demo))
    trial = trials_of(demo)[0]
    os.kill(trial, signal.SIGSTOP)  # The stopped trial never ends.
    demo.send_signal(signal.SIGINT)
    wait_until(lambda: not alive(trial))
    assert demo.wait() == 130
    assert "Traceback" not in demo.communicate()[1]


@pytest.mark.slow
def test_trials_end_when_their_demo_is_killed(demo: subprocess.Popen[str]) -> None:
    wait_until(lambda: len(trials_of(demo)) == min(2, os.cpu_count() or 1))
    trials = trials_of(demo)
    demo.kill()
    wait_until(lambda: not any(alive(trial) for trial in trials))


@pytest.mark.parametrize(("failed", "reliable"), [(0, True), (1, True), (2, False)])
def test_a_task_is_reliable_if_nineteen_of_twenty_trials_succeed(failed: int, reliable: bool) -> None:
    report = TrialReport("stack", 20, dict.fromkeys(range(failed), "fell"))
    assert report.is_reliable is reliable
