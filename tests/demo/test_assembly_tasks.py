"""The demo: two arms do small assembly work, driven only by samples of hands."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.demo.assembly_tasks import TASKS, TaskWatch, tasks_named, with_controls
from q2r2_control.demo.part_judges import TouchWatch
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.scripted import ScriptedInput, trajectory_named
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode
from tests.support.processes import Watch, assert_torque_bounds

pytestmark = pytest.mark.slow

# The tasks that are played in each mode, and the period of a tick. No task needs 1 kHz, and the tests have to be fast.
SHOWN = {CommandMode.POSITION: "meet+grasp+carry+handover+stack", CommandMode.TORQUE: "handover+stack"}
PERIODS = {CommandMode.POSITION: 0.01, CommandMode.TORQUE: 0.005}  # [s]


@cache
def coarse(mode: CommandMode = CommandMode.POSITION) -> Config:
    """Return the demo's cell with a slower control loop."""
    config, period = with_controls(load_config("config/dual_iiwa7.yaml")), PERIODS[mode]
    control = config.control.model_copy(update={"max_substep": period})
    return config.model_copy(update={"loop_rate_hz": 1.0 / period, "control": control})


class Played:
    """A run of tasks in simulated time until their end. The contract is checked at every tick."""

    def __init__(self, names: str, mode: CommandMode) -> None:
        config, self.mode = coarse(mode), mode
        robot = Robot.from_config(config)
        plant = MujocoPlant(robot, config)
        self.pipeline = Pipeline(config, robot, ScriptedInput(names), plant, mode)
        watch, tasks = Watch(self.pipeline), TaskWatch(tasks_named(names.split("+")), plant, robot, config)
        self.pipeline.listeners.append(tasks)
        self.summary = self.pipeline.run(trajectory_named(names).duration, realtime=False)
        self.ticks, self.results = watch.ticks, {result.name: result for result in tasks.results()}


@pytest.fixture(scope="module", params=list(SHOWN), ids=["by position", "by torque"])
def played(request: pytest.FixtureRequest) -> Played:
    return Played(SHOWN[request.param], request.param)


def test_every_task_succeeds_and_arms_touch_only_what_they_grasp(played: Played) -> None:
    assert "+".join(played.results) == SHOWN[played.mode]
    reasons = {name: result.reason for name, result in played.results.items() if not result.succeeded}
    assert reasons == {}
    handover, stack = (played.results[name].measured for name in ("handover", "stack"))
    assert handover["held_by_both_s"] > 0.3
    assert handover["carried_mm"] > 115.0
    assert stack["off_centre_mm"] < 2.0
    assert max(handover["fall_mm"], stack["fall_mm"]) < 2.0
    if played.mode is CommandMode.POSITION:
        grasp = played.results["grasp"].measured
        assert played.results["carry"].measured["tilt_deg"] < 2.0
        carried = {tick.states["right"] for tick in played.ticks}
        assert "carried" in carried
        assert grasp["lifted_mm"] > 99.0
        assert max(grasp["put_back_mm"], grasp["fall_mm"]) < 1.0


def test_the_arms_follow_the_hands_within_1_5_millimetres_and_need_no_fallback(played: Played) -> None:
    assert played.summary.fallback_ticks == played.summary.uncertified_ticks == played.summary.rejected_targets == 0
    assert played.summary.at_rest
    for arm in played.summary.arms.values():
        assert arm.position_error_mm_rms is not None
        # While two arms carry a part, one tool follows the other tool, and also corrects the lag of the other tool.
        assert arm.position_error_mm_rms < (1.5 if "carry" in played.results else 1.0)
    if played.mode is CommandMode.TORQUE:
        assert_torque_bounds(played.pipeline, played.ticks)
    # Fingers work within 3 mm of the table, and tools within 90 mm of each other.
    assert played.summary.min_distance_mm is not None
    assert played.summary.min_distance_mm < 3.0
    gaps = [np.linalg.norm(tick.tools["left"].translation - tick.tools["right"].translation) for tick in played.ticks]
    assert min(gaps) < 0.091


@pytest.mark.parametrize("name", ["wipe", "peg"])
def test_arms_in_torque_mode_wipe_with_the_wanted_force_and_find_the_hole_for_the_peg(name: str) -> None:
    result = Played(name, CommandMode.TORQUE).results[name]
    assert result.reason == ""
    if name == "wipe":
        assert result.measured["wiped_mm"] > 350.0
    else:
        assert result.measured["tilt_deg"] < 1.0


@pytest.mark.parametrize("mode", list(SHOWN))
def test_if_both_hands_move_to_the_same_point_the_arms_stop_before_they_touch(mode: CommandMode) -> None:
    played = Played("clash", mode)
    assert played.results["clash"].reason == ""
    led = [[tick.targets[arm].pose for arm in ("left", "right")] for tick in played.ticks]
    ways = [left.translation[1] - right.translation[1] for left, right in led if left is not None and right is not None]
    assert min(ways) < 1e-3  # The targets of both tools were at the same point.
    assert played.summary.at_rest
    assert played.summary.uncertified_ticks == 0


@pytest.mark.parametrize(
    ("q", "expected"),
    [
        pytest.param([0.0, 1.9, 0.0, -0.3, 0.0, 0.5, 0.0] * 2, ("left", "table"), id="an arm and the table"),
        pytest.param(
            [-1.57, 0.9, 0, -0.5, 0, 0.5, 0, 1.57, 0.9, 0, -0.5, 0, 0.5, 0], ("left", "right"), id="both arms"
        ),
    ],
)
def test_arms_that_touch_other_bodies_spoil_the_task_and_are_named(q: list[float], expected: tuple[str, str]) -> None:
    robot = Robot.from_config(coarse())
    plant = MujocoPlant(robot, coarse())
    touches = TouchWatch(plant, robot, ("bar",), tuple(coarse().mujoco.objects))
    touches.look(0.0)
    assert touches.forbidden == {}
    plant.reset(np.array(q))
    assert touches.look(0.5)["bar"].tilt < 1e-6
    assert any({name.split("_")[0] for name in pair} == set(expected) for pair in touches.forbidden)
    assert set(touches.forbidden.values()) == {0.5}


def test_tasks_are_sorted_into_the_order_in_which_they_can_be_done() -> None:
    assert [task.name for task in tasks_named(["stack", "meet", "stack"])] == ["meet", "stack"]
    assert tasks_named(["all"]) == tuple(TASKS.values())
    with pytest.raises(
        ConfigError, match="task 'juggle': allowed: meet, clash, grasp, carry, handover, stack, wipe, peg, all"
    ):
        tasks_named(["juggle"])


def test_a_cell_without_the_parts_of_a_task_is_refused() -> None:
    bare = coarse().model_copy(update={"mujoco": coarse().mujoco.model_copy(update={"objects": {}})})
    robot = Robot.from_config(bare)
    with pytest.raises(ConfigError, match="task grasp: dual_iiwa7 has no flat_block under mujoco"):
        TaskWatch(tasks_named(["grasp"]), MujocoPlant(robot, bare), robot, bare)
