"""Repeats tasks many times in simulated time. The hands tremble differently in each trial."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import active_children

from q2r2_control.config.cell import Config
from q2r2_control.demo.assembly_tasks import AssemblyTask, TaskWatch, held_to_promises, tasks_named, with_controls
from q2r2_control.errors import PlantError
from q2r2_control.inputs.scripted import ScriptedInput, hurried, trajectory_named
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.pools import pool_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode

_WANTED = 0.95  # The share of trials that have to succeed.


@dataclass(frozen=True, slots=True)
class TrialReport:
    """The trials of one task with the seeds 0, 1, ..."""

    task: str
    trials: int
    failures: dict[int, str]  # By seed, the reason of the failure.

    @property
    def succeeded(self) -> int:
        return self.trials - len(self.failures)

    @property
    def is_reliable(self) -> bool:
        """Return whether at least 19 of 20 trials succeed."""
        return self.succeeded >= _WANTED * self.trials


def try_tasks(
    config: Config,
    tasks: Sequence[AssemblyTask],
    mode: CommandMode,
    seeds: int,
    shaky: bool = False,
    progress: Callable[[str], None] = lambda line: None,
) -> list[TrialReport]:
    """Try each task by itself ``seeds`` times, in as many processes as there are processors."""
    jobs = [(task.name, seed) for task in tasks for seed in range(seeds)]
    failures: dict[str, dict[int, str]] = {task.name: {} for task in tasks}
    pool = pool_of(min(os.cpu_count() or 1, len(jobs)))
    try:
        for (task, seed), failure in zip(jobs, pool.map(partial(try_task, config, mode, shaky), jobs), strict=True):
            if failure:
                failures[task][seed] = failure
            progress(f"{task}, seed {seed}: {failure or 'succeeded'}")
    except KeyboardInterrupt:
        for worker in active_children():  # A trial takes long and has nothing to close, so it is killed.
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
    return [TrialReport(task, seeds, failed) for task, failed in failures.items()]


def try_task(config: Config, mode: CommandMode, shaky: bool, job: tuple[str, int]) -> str:
    """Try the task with the name and the seed of ``job``; returns why it failed, or an empty text after success."""
    name, seed = job
    config, work = with_controls(config), trajectory_named(name)
    work = hurried(work, seed) if shaky else work
    robot = Robot.from_config(config)
    plant = MujocoPlant(robot, config)
    pipeline = Pipeline(config, robot, ScriptedInput(name, human=True, seed=seed, shaky=shaky), plant, mode)
    pipeline.listeners.append(watch := TaskWatch(tasks_named([name]), plant, robot, config))
    try:
        summary = pipeline.run(work.duration, realtime=False)
    except PlantError as error:
        return str(error)
    return held_to_promises(watch.results(), summary)[0].reason
