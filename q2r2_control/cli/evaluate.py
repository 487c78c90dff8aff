"""``q2r2 evaluate``: count how often a policy succeeds in simulated tasks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from q2r2_control.cli.output import (
    DEMO_CONFIG,
    ClusterAddress,
    Json,
    as_json_text,
    notice_of_compiling,
    print_progress,
)
from q2r2_control.config.cell_file import load_config
from q2r2_control.demo.assembly_tasks import tasks_named
from q2r2_control.demo.trials import TrialReport, try_policy, try_tasks
from q2r2_control.extras import require
from q2r2_control.inputs.policy import PolicyInput
from q2r2_control.process.places import Processes, chosen_place
from q2r2_control.types import CommandMode


def evaluate(
    policy: Annotated[str, Argument(metavar="MODULE:NAME", help="The policy, as q2r2 run --policy takes it.")],
    tasks: Annotated[list[str], Argument(metavar="TASK...", help="Of q2r2 demo; all: every one.")],
    config: Annotated[str, Option(metavar="CONFIG", help="The cell; it has the tasks' parts.")] = DEMO_CONFIG,
    mode: Annotated[CommandMode, Option(help="What the arms get.")] = CommandMode.POSITION,
    seeds: Annotated[int, Option(min=1, help="Trials of each task, with the seeds from 0 on.")] = 20,
    spread: Annotated[float, Option(min=0, help="Parts lie elsewhere for each seed, by up to so much [m].")] = 0.01,
    workers: Annotated[
        int | None, Option(min=1, help="Processes, by default one for each processor; the result is the same.")
    ] = None,
    cluster: ClusterAddress = None,
    json: Json = False,
) -> None:
    """Let a policy try each task with many seeds in simulated time, and count successes.

    A trial takes as long as the scripted hands of the task. Lines on stdout say which seeds failed, and why.
    """
    require("sim", "q2r2 evaluate")
    cell, chosen = load_config(config), tasks_named(tasks)
    # The policy is made once here. If it cannot be made, the command ends with one line that says why.
    PolicyInput.from_config(cell, policy, named="MODULE:NAME")
    spec = find_spec(policy.partition(":")[0])
    module = None if spec is None or not spec.has_location else Path(str(spec.origin))
    trial = partial(try_policy, cell, mode, policy, spread)
    place = Processes(workers or os.cpu_count() or 1) if cluster is None else chosen_place(workers or 1, cluster)
    with notice_of_compiling():
        reports = try_tasks(chosen, trial, seeds, place, print_progress, module)
    print_trials(reports, json)


def print_trials(reports: Sequence[TrialReport], json: bool) -> None:
    """Print a line for each task on stdout, with the failed seeds, or the reports as JSON."""
    if json:
        print(as_json_text(reports))
    for report in () if json else reports:
        reasons = "".join(f"; seed {seed}: {reason}" for seed, reason in report.failures.items())
        print(f"{report.task}: {report.succeeded} of {report.trials}{reasons}")
