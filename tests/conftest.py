"""Whatever order tests run in and however busy the machine is, what they draw at random is the same."""

from __future__ import annotations

import pinocchio as pin
import pytest
from hypothesis import settings

# What plays minutes of motion, starts processes, or makes whole runs again and again: make test-slow.
SLOW = (
    "benchmark/test_feel_run.py",
    "benchmark/test_loop_times.py",
    "benchmark/test_press_run.py",
    "benchmark/test_stack_run.py",
    "cli/test_app.py::test_a_search_for_pairs_says_how_far_it_has_got",
    "cli/test_app.py::test_bench",
    "control/test_work.py",
    "drives/test_drive.py",
    "export/",
    "headset_faults/",
    "judging/test_judge.py",
    "judging/test_parts.py",
    "recording/test_cameras.py",
    "recording/test_recorder.py",
    "recording/test_replay.py",
    "recording/test_writer_process.py",
    "robot/test_reachability.py",
    "robot/test_shared_robot.py",
    "supervision/test_joint_homing.py::test_from_fifty",
    "teleop/test_rest.py",
    "test_acceptance.py",
    "test_cockpit.py",
    "test_pipeline.py::test_both_arms_follow_within_every_limit",
    "test_pipeline.py::test_ten_thousand",
    "test_pipeline_bindings.py",
    "test_project.py::test_every_command",
    "verification/test_assembly_tasks.py",
    "verification/test_soak.py",
)

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def _seeded_pinocchio() -> None:
    """Seed ``pin.SE3.Random`` and the like, which share one generator."""
    pin.seed(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark those of :data:`SLOW`."""
    for item in items:
        if item.nodeid.removeprefix("tests/").startswith(SLOW):
            item.add_marker(pytest.mark.slow)
