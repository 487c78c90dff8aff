"""Tasks of the demo, each tried with several trembling hands."""

from __future__ import annotations

import pytest

from q2r2_control.demo.assembly_tasks import tasks_named
from q2r2_control.demo.trials import TrialReport, try_task, try_tasks
from q2r2_control.types import CommandMode
from tests.demo.test_assembly_tasks import coarse


@pytest.mark.slow
def test_every_seed_is_tried_and_those_that_fail_say_why() -> None:
    config = coarse()
    (report,) = try_tasks(config, tasks_named(["grasp"]), CommandMode.POSITION, 2)
    assert report == TrialReport("grasp", 2, {})
    block = config.mujoco.objects["flat_block"]
    elsewhere = block.model_copy(update={"position": (0.45, -0.40, block.position[2])})
    objects = {**config.mujoco.objects, "flat_block": elsewhere}
    moved = config.model_copy(update={"mujoco": config.mujoco.model_copy(update={"objects": objects})})
    assert "flat_block: held 95 mm up for 0.0 s" in try_task(moved, CommandMode.POSITION, False, ("grasp", 0))


@pytest.mark.parametrize(("failed", "reliable"), [(0, True), (1, True), (2, False)])
def test_nineteen_of_twenty_are_reliable(failed: int, reliable: bool) -> None:
    report = TrialReport("stack", 20, dict.fromkeys(range(failed), "fell"))
    assert report.is_reliable is reliable
