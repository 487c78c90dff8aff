"""Whatever order tests run in and however busy the machine is, what they draw at random is the same."""

from __future__ import annotations

import pinocchio as pin
import pytest
from hypothesis import settings

# What plays minutes of motion, starts processes, compiles, or makes whole runs again and again: make test-slow.
SLOW = (
    "control/test_live_settings.py::test_a_distance_that_grows_while_the_arms_rush",
    "control/test_live_settings.py::test_a_pair_keeps_all",
    "control/test_live_settings.py::test_arms_that_rest_against_each_other",
    "benchmark/test_feel_run.py",
    "benchmark/test_loop_times.py",
    "benchmark/test_press_run.py",
    "benchmark/test_stack_run.py",
    "benchmark/test_tick_times.py",
    "benchmark/test_work_bench.py",
    "cli/test_app.py::test_a_search_for_pairs_says_how_far_it_has_got",
    "cli/test_app.py::test_a_run_by_torque_repeats_itself",
    "cli/test_app.py::test_bench",
    "cli/test_app.py::test_ctrl_c",
    "cli/test_app.py::test_headset_check_shows",
    "cli/test_app.py::test_the_demo",
    "cli/test_judge.py::TestARunThatIsRecorded",
    "cli/test_replay.py",
    "control/test_contract.py::test_every_solver_keeps_the_contract_and_tracks[osqp]",
    "control/test_contract.py::test_separation_holds_between_ticks",
    "control/test_jit.py::test_kernels_run_where_no_cache",
    "control/test_jit.py::test_what_is_held",
    "control/test_scenarios.py::test_the_contract_holds_at_every_tick[1 ms-panda",
    "control/test_scenarios.py::test_the_contract_holds_at_every_tick[2 ms",
    "control/test_turning_openings.py::test_with_hostile_targets",
    "control/test_work.py",
    "drives/test_drive.py",
    "export/",
    "headset_faults/",
    "judging/test_episode_judge.py",
    "judging/test_judge.py",
    "judging/test_parts.py",
    "pipeline/test_bindings.py",
    "pipeline/test_end_of_run.py::TestFailure",
    "pipeline/test_end_of_run.py::TestStop",
    "pipeline/test_grippers.py::test_what_is_gripped",
    "pipeline/test_hostile_samples.py",
    "pipeline/test_pipeline.py::test_both_arms_follow_within_every_limit",
    "pipeline/test_pipeline.py::test_two_simulated_runs",
    "plants/test_mujoco_meshes.py::test_a_cell_with_dae",
    "recording/test_cameras.py",
    "recording/test_joint_replay.py",
    "recording/test_recorder.py",
    "recording/test_replay.py",
    "recording/test_ros_recording.py",
    "recording/test_writer_process.py",
    "robot/test_model_srdf.py::test_every_shipped_file_about_a_flange",
    "robot/test_reachability.py",
    "robot/test_shared_robot.py",
    "robot/test_turning_fingers.py::test_grippers_that_turn_of_other_robots",
    "robot/test_turning_fingers.py::test_any_chain_of_fingers",
    "ros/test_build.py",
    "ros/test_carry.py::test_simulated_tools",
    "ros/test_drives.py::test_a_controller_that_is_stopped",
    "ros/test_faults.py::test_however_short",
    "ros/test_latency.py",
    "ros/test_presets.py::test_joint_commands",
    "ros/test_presets.py::test_targets",
    "ros/test_readme.py::test_the_command_in_the_readme_moves_both_arms",
    "ros/test_recorder.py::test_a_whole_set",
    "ros/test_set_listener.py::test_the_doctor_finds_two_inputs",
    "ros/test_simulation_input.py::test_an_arm_that_stops_early",
    "supervision/test_joint_homing.py::test_from_fifty",
    "teleop/test_leash.py::test_tremor",
    "teleop/test_leash.py::test_without_a_leash",
    "teleop/test_rest.py",
    "test_acceptance.py",
    "test_cockpit.py",
    "test_dataset_of_episodes.py",
    "test_project.py::test_every_command",
    "test_stalls.py",
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
