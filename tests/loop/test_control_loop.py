"""One tick of control: when arms are commanded, which targets are refused, and which gripper openings are permitted."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import make_drive
from q2r2_control.events import Reason
from q2r2_control.loop.control_loop import ControlLoop, LoopStep, without_proof
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.joint_watch import watch_settings
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.types import CommandMode, RobotState
from tests.support.processes import cell, cell_robot

DT = 0.004


class Arms:
    """Both arms at rest at home, with a control loop whose commands do not move them."""

    def __init__(self, owns_plant: bool, obstacles: tuple[str, ...] = ()) -> None:
        config, robot = cell(), cell_robot()
        drive, watch = make_drive(CommandMode.POSITION, robot, config), watch_settings(config.supervision, False)
        settings = config.control.timed(realtime=False).model_copy(update={"moving_obstacles": obstacles})
        controller = CartesianController(robot, settings)
        self.loop = ControlLoop(controller, drive, DT, StreamSettings(), watch, owns_plant=owns_plant)
        self.home, self.now = robot.home, 0.0

    @property
    def state(self) -> RobotState:
        zero = np.zeros_like(self.home)
        return RobotState(self.home, zero, zero, None, self.now)

    def tick(self, target: pin.SE3 | None = None) -> LoopStep:
        self.now += DT
        self.loop.observe(self.state, self.now, DT)
        return self.loop.step(self.state, {"left": target}, self.now, DT, {"left": 1.0}, {})


def test_if_another_program_owns_the_plant_commands_start_when_the_arms_have_rested_and_end_at_a_stop() -> None:
    arms = Arms(owns_plant=False)
    assert arms.tick().command is None
    while arms.loop.supervisor.phase is not Phase.ACTIVE:
        assert arms.tick().command is None
    assert arms.tick().command is not None
    arms.loop.supervisor.stop(Reason(RosReason.STOP_SERVICE))
    for _ in range(10):
        step = arms.tick()
    assert arms.loop.supervisor.arm_state("left") == "stopped"
    assert step.command is None


def test_if_the_loop_owns_the_plant_the_plant_gets_commands_while_the_arms_are_stopped() -> None:
    arms = Arms(owns_plant=True)
    arms.loop.activate(arms.state, arms.now)
    arms.loop.supervisor.stop(Reason(RosReason.STOP_SERVICE))
    for _ in range(10):
        step = arms.tick()
    assert arms.loop.supervisor.phase is Phase.STOPPED
    assert step.command is not None
    assert np.array_equal(step.command.q, arms.home)


def test_a_target_far_from_its_tool_is_refused_and_moves_nothing() -> None:
    arms = Arms(owns_plant=True)
    arms.loop.activate(arms.state, arms.now)
    tool = arms.loop.controller.tool_pose("left")
    step = arms.tick(tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.2])))
    assert set(step.refusals) == {"left"}
    assert step.reference is not None
    assert np.abs(step.reference.v).max() < 1e-9
    assert arms.tick(None).refusals == {}
    assert arms.tick(tool).refusals == {}


def test_joint_states_that_are_not_finite_are_not_trusted() -> None:
    arms = Arms(owns_plant=True)
    arms.loop.activate(arms.state, arms.now)
    assert arms.tick().trusted
    arms.home = np.full_like(arms.home, np.nan)
    while arms.loop.supervisor.state_fault is None:
        step = arms.tick()
        assert arms.now < 1.0
    assert not step.trusted


def test_after_the_end_of_a_fri_session_states_are_trusted_until_a_state_jumps() -> None:
    arms = Arms(owns_plant=True)
    arms.loop.activate(arms.state, arms.now)
    arms.loop.observe(arms.state, arms.now, DT, lost=Reason.of(FriReason.FRI_DROPPED, arm="left"))
    assert arms.tick().trusted
    assert arms.loop.supervisor.state_fault is not None
    arms.home = arms.home + 0.5  # No arm can be at this posture.
    assert not arms.tick().trusted


@pytest.mark.parametrize(
    ("before", "wanted", "granted"),
    [
        pytest.param(None, 0.3, 0.3, id="anything where nothing was asked for"),
        pytest.param((0.8, 0.8), 0.0, 0.0, id="anything to one that was not held"),
        pytest.param((1.0, 0.4), 1.0, 0.4, id="no farther open to one that was held while opening"),
        pytest.param((1.0, 0.4), 0.1, 0.1, id="less open to that one"),
        pytest.param((0.0, 0.6), 0.0, 0.6, id="no farther closed to one that was held while closing"),
        pytest.param((0.0, 0.6), 0.9, 0.9, id="less closed to that one"),
    ],
)
def test_while_arms_rest_a_gripper_that_was_not_allowed_its_wanted_opening_may_move_only_back(
    before: tuple[float, float] | None, wanted: float, granted: float
) -> None:
    assert without_proof(wanted, before) == granted


class ReportedHand(Arms):
    """Arms, and a moving obstacle far from them that is reported only once, before the first tick."""

    def __init__(self, owns_plant: bool) -> None:
        super().__init__(owns_plant, ("hand",))
        self.loop.controller.move_obstacle(
            "hand", MovingObstacle(shape="sphere", size=(0.1,), position=(9.0, 9.0, 9.0), speed=0.1)
        )

    @property
    def age(self) -> float:
        return self.loop.controller.obstacle_reports["hand"].age


@pytest.mark.slow
def test_the_age_of_a_hands_report_grows_with_the_clock_even_if_the_loop_stalls() -> None:
    arms = ReportedHand(owns_plant=True)
    arms.loop.activate(arms.state, arms.now)
    first = arms.now + DT
    for tick in range(200):
        arms.now += 0.06 if tick % 40 == 39 else 0.0  # The loop stalls, but this tick still lasts DT.
        arms.tick()
        assert arms.now - first - 1e-9 <= arms.age <= arms.now - first + DT + 1e-5


def test_the_time_before_a_late_first_tick_makes_a_hands_report_older() -> None:
    arms = ReportedHand(owns_plant=True)
    arms.loop.activate(arms.state, arms.now)
    first = arms.now + DT
    arms.loop.age_obstacles(first)
    arms.now += 0.3
    arms.tick()
    assert arms.now - first - 1e-9 <= arms.age <= arms.now - first + DT + 1e-5


def test_the_age_of_a_hands_report_grows_while_the_plant_of_another_program_gets_no_commands() -> None:
    arms = ReportedHand(owns_plant=False)
    first = arms.now + DT
    for _ in range(500):
        arms.tick()
        arms.loop.supervisor.stop(Reason(RosReason.STOP_SERVICE))
    assert arms.now - first - 1e-9 <= arms.age <= arms.now - first + DT + 1e-5
