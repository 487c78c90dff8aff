"""Repeats tasks many times in simulated time, with a policy, or with scripted hands whose tremor differs each time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.demo.assembly_tasks import (
    AssemblyTask,
    TaskWatch,
    held_to_promises,
    tasks_named,
    with_controls,
    with_parts_at,
)
from q2r2_control.errors import PlantError
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.policy import PolicyInput
from q2r2_control.inputs.scripted import ScriptedInput, hurried, place_of, trajectory_named
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.process.places import JobPlace
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode

# A function that makes one trial, with the name of a task and a seed. It returns why the trial failed, or "" after
# success. Other processes have to be able to import it.
Trial = Callable[[tuple[str, int]], str]
_WANTED = 0.95  # The share of trials that have to succeed.


@dataclass(frozen=True, slots=True)
class TrialReport:
    """The trials of one task with the seeds 0, 1, ..."""

    task: str
    trials: int
    failures: dict[int, str]  # For each seed with a failure: the reason.

    @property
    def succeeded(self) -> int:
        return self.trials - len(self.failures)

    @property
    def is_reliable(self) -> bool:
        """Return whether at least 19 of 20 trials succeed."""
        return self.succeeded >= _WANTED * self.trials


def try_tasks(
    tasks: Sequence[AssemblyTask],
    trial: Trial,
    seeds: int,
    place: JobPlace,
    progress: Callable[[str], None] = lambda line: None,
    reads: Path | None = None,
) -> list[TrialReport]:
    """Try each task alone with the seeds 0 .. ``seeds`` - 1. The ``place`` of the trials does not change the reports.

    ``reads`` is the file that trials read; None if they read no file.
    """
    jobs = [(task.name, seed) for task in tasks for seed in range(seeds)]
    failures: dict[str, dict[int, str]] = {task.name: {} for task in tasks}
    with closing(place.results(trial, jobs, None if reads is None else lambda job: reads)) as results:
        for (task, seed), failure in zip(jobs, results, strict=True):
            if failure:
                failures[task][seed] = failure
            progress(f"{task}, seed {seed}: {failure or 'succeeded'}{place.where}")
    return [TrialReport(task, seeds, failed) for task, failed in failures.items()]


def try_task(config: Config, mode: CommandMode, shaky: bool, job: tuple[str, int]) -> str:
    """Let scripted hands try the task of ``job`` with its seed; returns why it failed, or "" after success."""
    name, seed = job
    work = trajectory_named(name)
    work = hurried(work, seed) if shaky else work
    hands = ScriptedInput(name, human=True, seed=seed, shaky=shaky)
    return _failure_of(with_controls(config), hands, mode, name, work.duration)


def try_policy(config: Config, mode: CommandMode, policy: str, spread: float, job: tuple[str, int]) -> str:
    """Let the ``policy`` MODULE:NAME try the task of ``job`` with its seed, in the time that scripted hands take.

    The seed displaces the parts along x and along y by up to ``spread`` [m]. Returns why the task failed, or "".
    """
    name, seed = job
    config = with_parts_at(config, tasks_named([name]), place_of(seed, spread))
    source = PolicyInput.from_config(config, policy)
    return _failure_of(config, source, mode, name, trajectory_named(name).duration)


def _failure_of(config: Config, source: Input, mode: CommandMode, task: str, duration: float | None) -> str:
    """Return why a task fails if ``source`` moves the arms for ``duration`` [s], or "" if it succeeds."""
    from q2r2_control.plants.mujoco import MujocoPlant  # The import is here, because reports need no MuJoCo.

    robot = Robot.from_config(config)
    plant = MujocoPlant(robot, config)
    pipeline = Pipeline(config, robot, source, plant, mode)
    pipeline.listeners.append(watch := TaskWatch(tasks_named([task]), plant, robot, config))
    try:
        summary = pipeline.run(duration, realtime=False)
    except PlantError as error:
        return str(error)
    return held_to_promises(watch.results(), summary)[0].reason
