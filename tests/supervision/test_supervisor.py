"""The supervisor's rules for the motion of arms, tested with the real controller but without ROS and a real clock."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.events import CommonReason, Reason
from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.types import Array, RobotState
from q2r2_control.wording import sentence
from tests.supervision.conftest import STRICT, raised
from tests.support.reasons import kinds

DT = 0.004


class World:
    """A supervisor and arms that are at its references, unless they are blocked."""

    def __init__(self, robot: Robot, controller: CartesianController) -> None:
        self.streams = StreamSettings()
        self.supervisor, self.tool = Supervisor(robot, controller, self.streams, STRICT), controller.tool_pose
        self.q, self.now, self.blocked = robot.home.copy(), 0.0, False
        self._robot = robot
        self.v, self.lag = np.zeros_like(self.q), DT  # Lag of the arms [s].
        self.commanded: list[Array | None] = []

    @property
    def states(self) -> list[str]:
        """Return the activities of the left arm and of the right arm."""
        return [self.supervisor.arm_state(arm) for arm in ("left", "right")]

    def measured_tool(self, arm: str) -> pin.SE3:
        return self._robot.tool_pose(self.q, arm)

    def engage(self, by: float = 0.0, seconds: float = 0.3) -> pin.SE3:
        """Let the left arm follow and move up ``by`` [m]. Return its tool pose before the motion."""
        self.run(0.2)
        tool = self.tool("left")
        self.run(0.02, tool)
        self.run(seconds, raised(tool, by))
        assert self.states == ["following", "holding"]
        return tool

    def engage_both(self) -> tuple[pin.SE3, pin.SE3]:
        """Let both arms follow targets at rest. Return these targets."""
        self.run(0.2)
        left, right = self.tool("left"), self.tool("right")
        self.run(0.1, left, right=right)
        assert self.states == ["following"] * 2
        return left, right

    def run(
        self, seconds: float, target: pin.SE3 | None = None, sees: bool = True, right: pin.SE3 | None = None
    ) -> None:
        """Let time pass with constant targets: ``target`` for the left arm, ``right`` for the right arm.

        Joint states come only if ``sees`` is True.
        """
        zero = np.zeros_like(self.q)
        for _ in range(round(seconds / DT)):
            self.now += DT
            if sees:
                self.supervisor.update_state(RobotState(self.q, self.v, zero, None, self.now), self.now)
            if target is not None:
                self.supervisor.update_target("left", target, self.now)
            if right is not None:
                self.supervisor.update_target("right", right, self.now)
            reference = self.supervisor.tick(self.now, DT)
            self.commanded.append(None if reference is None else reference.q)
            self.v = zero if reference is None or self.blocked else (reference.q - self.q) / self.lag
            self.q = self.q + self.v * DT


@pytest.fixture
def world(robot: Robot, controller: CartesianController) -> World:
    return World(robot, controller)


def test_nothing_is_commanded_before_joint_states_are_valid_and_the_arms_rest(world: World, robot: Robot) -> None:
    world.run(0.5, sees=False)
    assert world.commanded == [None] * len(world.commanded)
    for step in range(50):  # A person pushes the arm.
        world.q = robot.home + 0.005 * step
        world.run(0.008)
    assert world.states == ["inactive"] * 2
    world.run(0.2)
    assert world.states == ["holding"] * 2
    first = next(q for q in world.commanded if q is not None)
    assert np.allclose(first, world.q, atol=1e-9)


def test_each_reason_why_arms_cannot_be_activated_is_logged_once(world: World) -> None:
    gone, stalled = Reason(CommonReason.OTHER), Reason.of(CommonReason.LOOP_STALLED, duration=1.0)
    for why in (gone, gone, stalled, stalled):
        world.supervisor.update_state(why, world.now)
        world.run(DT, sees=False)
    assert list(map(kinds, world.supervisor.events)) == ["joint_states: other", "joint_states: loop_stalled"]


def test_arms_that_are_stopped_again_while_they_rest_are_reset_at_once(world: World) -> None:
    for _ in range(2):
        world.supervisor.stop(Reason(CommonReason.OTHER))
        assert world.states == ["stopped"] * 2
    assert world.supervisor.reset() is None


def test_arms_that_were_stopped_before_their_activation_are_activated_only_after_a_reset(world: World) -> None:
    world.supervisor.stop(Reason(CommonReason.OTHER))
    world.run(0.5)
    assert world.states == ["stopped"] * 2
    assert world.supervisor.reset() is None
    world.run(0.2)
    assert world.states == ["holding"] * 2


def test_the_first_reference_is_the_posture_that_the_drives_hold(world: World) -> None:
    """The measured arms sag below it. If references began at the measured posture, the arms would sag at each start."""
    held, zero = world.q + 0.02, np.zeros_like(world.q)
    references: list[Array] = []
    while not references:
        world.now += DT
        world.supervisor.update_state(RobotState(world.q, zero, zero, None, world.now, held=held), world.now)
        if (reference := world.supervisor.tick(world.now, DT)) is not None:
            references.append(reference.q)
        assert world.now < 1.0
    np.testing.assert_allclose(references[0], held, atol=1e-6)


def test_an_arm_that_was_pushed_away_from_its_reference_is_engaged_where_it_is(world: World) -> None:
    world.run(0.2)
    world.blocked = True
    world.q = world.q + np.eye(len(world.q))[0] * 0.08
    world.run(0.02)
    pushed = world.measured_tool("left")
    assert np.linalg.norm(pushed.translation - world.tool("left").translation) > world.streams.engage_distance
    assert world.supervisor.update_target("left", pushed, world.now) is None
    assert world.states == ["following", "holding"]


def test_if_the_targets_of_one_linked_arm_end_both_arms_hold_until_each_gets_a_new_stream(world: World) -> None:
    _, right = world.engage_both()
    world.run(0.3, right=raised(right, 0.01))
    assert not world.supervisor.follows("right")
    assert [reason.root.kind for reason in world.supervisor.targets.ended.values()] == ["targets_ceased"] * 2
    words = [sentence(reason) for reason in world.supervisor.targets.ended.values()]
    assert words[0] == "left holds because its targets have ceased"
    assert words[1] == f"right holds because it is linked to left: {words[0]}", "no word stands twice"
    assert world.supervisor.ceased is not None
    assert world.supervisor.ceased.root.kind == "targets_ceased"
    rest = world.tool("right")
    world.run(1.0, right=raised(right, 0.02))  # The right arm's stream goes on.
    assert np.allclose(world.tool("right").translation, rest.translation, atol=1e-6)
    world.run(0.2)
    world.run(0.1, world.tool("left"), right=world.tool("right"))
    assert world.states == ["following"] * 2
    assert world.supervisor.targets.ended == {}
    assert world.supervisor.ceased is None


def test_a_target_just_after_the_timeout_does_not_hide_that_targets_had_ended(world: World) -> None:
    left, right = world.engage_both()
    for _ in range(3):
        world.now += 0.07
        world.supervisor.update_target("right", right, world.now)
    world.supervisor.update_target("left", left, world.now)
    assert world.states == ["following", "holding"]


def test_two_publishers_for_one_linked_arm_stop_both_arms(world: World) -> None:
    left, _ = world.engage_both()
    found = [kinds(world.supervisor.update_target("left", left, world.now, number)) for number in (900, 5, 901, 6)]
    assert found == ["", "publisher_changed", "two_publishers", "two_publishers"]
    assert world.states == ["holding"] * 2


@pytest.mark.parametrize("linked", [True, False], ids=["that its sender ends", "of an arm that is not linked"])
def test_the_end_of_a_stream_may_stop_only_its_own_arm(world: World, linked: bool) -> None:
    world.streams.linked = linked
    _, right = world.engage_both()
    if linked:
        world.supervisor.targets.release("left")
    world.run(0.5, right=right)
    assert world.states == ["holding", "following"]


def test_a_loop_that_stood_still_commands_nothing_and_follows_no_old_target(world: World) -> None:
    world.engage(by=0.1)
    rest, before = world.q, len(world.commanded)  # While the loop stands still, the robot rests here.
    waited = world.tool("left")
    world.now += 1.0
    world.supervisor.stalled(1.0, world.now)
    assert world.supervisor.fault == Reason.of(CommonReason.LOOP_STALLED, duration=1.0)
    world.run(0.05, raised(waited, 0.01))
    assert world.commanded[before:] == [None] * (len(world.commanded) - before)
    world.run(1.0, raised(waited, 0.01))
    assert world.states == ["holding"] * 2
    assert np.allclose(world.q, rest, atol=1e-9)


def test_arms_that_were_stopped_stay_stopped_after_the_loop_stood_still(world: World) -> None:
    world.engage(by=0.1)
    world.supervisor.stop(Reason(CommonReason.OTHER))
    world.now += 1.0
    world.supervisor.stalled(1.0, world.now)
    world.run(0.5)
    assert world.states == ["stopped"] * 2
    assert kinds(world.supervisor.fault) == "other"


def test_the_loss_of_joint_states_brakes_the_arms_and_the_return_of_the_states_moves_no_arm(world: World) -> None:
    tool, before = world.engage(by=0.1), world.q
    world.run(0.6, raised(tool, 0.1), sees=False)
    assert world.states == ["inactive"] * 2
    assert kinds(world.supervisor.fault) == "states_silent"
    assert kinds(world.supervisor.ceased) == "joint_states: states_silent"
    assert np.abs(world.q - before).max() < 0.3
    rest = world.q
    world.run(1.0, raised(tool, 0.1))
    assert world.states == ["holding"] * 2
    assert world.supervisor.fault is None
    assert np.allclose(world.q, rest, atol=1e-9)
    assert [kinds(event) for event in world.supervisor.events].count("joint_states: states_silent") == 1
    assert kinds(world.supervisor.events[1]) == "joint_states: states_silent"


def test_if_a_joint_cannot_bear_gravity_its_arm_is_stopped_and_the_reason_tells_the_torque(
    world: World, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot, "torque_limit", np.full_like(robot.torque_limit, 1e-3))
    tool = world.engage()
    world.blocked = True
    world.run(2.0, raised(tool, 0.2))
    assert kinds(world.supervisor.fault) == "too_heavy"
    fault = world.supervisor.fault
    assert fault is not None
    assert re.search(r"gravity alone asks it for \d+\.\d Nm; .* its torque limit, 0\.001 Nm$", sentence(fault))


def test_arms_that_do_not_follow_their_reference_are_stopped_until_a_reset(world: World) -> None:
    tool = world.engage()
    world.blocked = True
    world.run(2.0, raised(tool, 0.2))
    assert world.states == ["stopped"] * 2
    assert kinds(world.supervisor.fault) == "off_reference"
    world.run(1.0)
    assert world.states == ["stopped"] * 2
    assert world.supervisor.reset() is None
    world.blocked = False
    rest = world.q
    world.run(0.3, raised(tool, 0.2))
    assert world.states == ["holding"] * 2
    assert np.allclose(world.q, rest, atol=1e-9)


def test_homing_ends_at_home_and_targets_do_not_change_its_path(world: World) -> None:
    tool = world.engage(by=0.1, seconds=1.0)
    assert world.supervisor.go_home() is None
    world.run(4.0, raised(tool, 0.1))
    assert "homing_outcome: homing_arrived" in map(kinds, world.supervisor.events)
    assert np.linalg.norm(world.tool("left").translation - tool.translation) < 3e-3
    assert world.supervisor.arm_state("left") == "holding"


def test_targets_are_not_followed_any_more_when_a_reason_forbids_it(world: World) -> None:
    tool = world.engage()
    world.supervisor.paused = True
    assert kinds(world.supervisor.update_target("left", tool, world.now)) == "controller_paused"
    assert not world.supervisor.follows("left")


def test_the_loss_of_the_receiver_of_commands_is_noticed_and_a_new_receiver_gets_no_jump(world: World) -> None:
    tool = world.engage()
    world.blocked = True  # The program that moved the arms is gone.
    world.run(0.3, raised(tool, 0.06))
    last = world.commanded[-1]
    assert last is not None
    assert 0.05 < np.abs(last - world.q).max() < 0.15
    assert world.supervisor.off_reference
    world.supervisor.let_go(Reason(CommonReason.OTHER), world.now)
    assert world.states == ["inactive"] * 2
    began = len(world.commanded)
    world.run(0.5, raised(tool, 0.06))
    assert world.states == ["holding"] * 2
    assert all(np.abs(q - world.q).max() < 1e-6 for q in world.commanded[began:] if q is not None)


def test_braking_arms_go_on_braking_when_their_receiver_is_gone(world: World) -> None:
    world.engage(by=0.1)
    world.supervisor.stop(Reason(CommonReason.OTHER))
    world.supervisor.let_go(Reason(CommonReason.OTHER), world.now)
    world.supervisor.start_over(Reason(CommonReason.OTHER), world.now)
    assert kinds(world.supervisor.reset()) == "arms_braking"
    world.run(DT)
    assert world.commanded[-1] is not None
    trusted = [world.supervisor.trusted]
    world.run(0.5)
    assert world.states == ["stopped"] * 2
    assert [*trusted, world.supervisor.trusted] == [True, False], "drives of torques brake by the measured states"
    assert kinds(world.supervisor.fault) == "other"


def test_arms_that_only_lag_behind_their_commands_do_not_count_as_off_their_reference(world: World) -> None:
    tool = world.engage()
    world.lag = 0.06
    deviation = 0.0
    for _ in range(100):
        world.run(DT, raised(tool, 0.1))
        assert world.commanded[-1] is not None
        deviation = max(deviation, float(np.abs(world.commanded[-1] - world.q).max()))
        assert not world.supervisor.off_reference
    assert deviation > 0.03
    assert world.supervisor.follows("left")


def test_if_arms_brake_near_each_other_they_rest_after_their_stop_and_do_not_move_apart_by_themselves(
    world: World, controller: CartesianController
) -> None:
    world.q = np.array([-0.8, 0.42, -0.69, -1.49, 0.43, 1.12, -0.28, 0.52, 0.47, 0.18, -1.31, -0.02, 1.32, 0.36])
    world.run(0.2)
    begun = world.q.copy()
    velocity = np.array([*np.zeros(7), 0.49, 0.22, -0.14, 0.16, 0.42, 0.34, -0.01])
    controller.reset(begun, velocity)
    world.supervisor.stop(Reason(CommonReason.OTHER))
    world.run(float(np.abs(velocity).max()) / controller.settings.acceleration_limit + 0.05)
    assert np.abs(world.v).max() < 1e-9
    np.testing.assert_array_equal(world.q[:7], begun[:7])
