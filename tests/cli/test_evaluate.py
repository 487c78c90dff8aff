"""Policies are tried in tasks from the command line, as a user does it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from q2r2_control.demo.assembly_tasks import tasks_named
from q2r2_control.demo.trials import TrialReport, try_policy, try_tasks
from q2r2_control.inputs.scripted import ScriptedInput, trajectory_named
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.places import HERE
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array, CommandMode
from tests.cli.command import q2r2
from tests.demo.test_assembly_tasks import coarse

RATE = 30.0  # Rate of the actions [Hz].
POLICY = f"""
import numpy as np

class Replayed:
    space, rate = "action", {RATE}

    def __init__(self):
        self.rows, self.start = np.load("rows.npy"), None

    def __call__(self, seen):
        self.start = seen.time if self.start is None else self.start
        first = min(round((seen.time - self.start) * self.rate), len(self.rows) - 1)
        return self.rows[first : first + 15]

class Resting(Replayed):
    def __init__(self):
        super().__init__()
        self.rows = self.rows[:1]
"""


def rows_of_scripted_hands(task: str) -> Array:
    """Return the reference's joint positions and the openings (n, size) of a scripted run, at the rate of actions."""
    config = coarse()
    robot, rows = Robot.from_config(config), list[Array]()
    pipeline = Pipeline(config, robot, ScriptedInput(task), MujocoPlant(robot, config), CommandMode.POSITION)

    def keep(tick: Tick) -> None:
        if tick.t >= len(rows) / RATE:
            rows.append(np.array([*tick.reference.q, *tick.command.grippers.values()]))

    pipeline.listeners.append(keep)
    pipeline.run(trajectory_named(task).duration, realtime=False)
    return np.array(rows)


@pytest.mark.slow
def test_a_policy_grasps_if_it_repeats_scripted_hands_and_does_not_grasp_if_it_rests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "replayed_policy.py").write_text(POLICY)
    np.save(tmp_path / "rows.npy", rows_of_scripted_hands("grasp"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("q2r2_control.cli.evaluate.load_config", lambda name: coarse())
    monkeypatch.setattr("q2r2_control.cli.evaluate.Processes", lambda most: HERE)
    command = ("evaluate", "replayed_policy:Replayed", "grasp", "--seeds", "1")
    assert q2r2(*command, "--spread", "0").stdout == "grasp: 1 of 1\n"
    rests = q2r2(*command[:1], "replayed_policy:Resting", *command[2:])
    assert rests.stdout.startswith("grasp: 0 of 1; seed 0: flat_block: held")


def test_a_policy_that_cannot_be_loaded_is_refused_in_one_line_before_any_trial() -> None:
    result = q2r2("evaluate", "nowhere:Policy", "grasp")
    assert result.exit_code == 2
    assert result.stderr.startswith("q2r2: MODULE:NAME nowhere:Policy: No module named 'nowhere'; ")
    assert f"in the working directory, {Path.cwd()}, and among installed packages" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_the_seed_of_a_trial_displaces_the_parts_of_its_task(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[float, ...]] = []

    def note(config: object, *given: object) -> str:
        seen.append(config.mujoco.objects["flat_block"].position)  # type: ignore[attr-defined]
        return ""

    monkeypatch.setattr("q2r2_control.demo.trials._failure_of", note)

    def trial(job: tuple[str, int]) -> str:
        return try_policy(coarse(), CommandMode.POSITION, "examples.policy:Circles", 0.01, job)

    assert try_tasks(tasks_named(["grasp"]), trial, 2, HERE) == [TrialReport("grasp", 2, {})]
    there = np.array(coarse().mujoco.objects["flat_block"].position)
    moved = np.abs(np.array(seen) - there)
    assert (moved[:, :2] > 0.0).all()
    assert (moved <= 0.01).all()
    assert seen[0] != seen[1]
