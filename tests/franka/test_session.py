"""The session of one arm in virtual time: commands go on every millisecond, also if the loop is late."""

from __future__ import annotations

import numpy as np
import pytest
from q2r2_franka import limits
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.session import ArmSession, ahead_of_others, follow
from q2r2_franka.state import ArmCommand, Measured, Mode

from q2r2_control.types import CommandMode

Q = tuple(0.5 * (limits.LOWER + limits.UPPER))
TICK = 0.002  # [s]
SPEED, ACCELERATION = 0.2, 4.0  # [rad/s], [rad/s^2]


class Arm:
    """A session whose robot asks every millisecond."""

    def __init__(self, mode: CommandMode = CommandMode.POSITION) -> None:
        self.session = ArmSession("left", "127.0.0.1", mode, limits.TORQUE)
        self.now, self.v = 0.0, (0.0,) * JOINTS
        self.held, self.held_tau = Q, (0.0,) * JOINTS  # The last commands, which this robot always takes.
        self.session.hear(self._measured(), self.now)
        self.session.begin(np.array(Q), self.now)

    def _measured(self, cycles: int = 1) -> Measured:
        none = (0.0,) * JOINTS
        return Measured(Mode.MOVE, "", cycles, Q, self.v, none, none, self.held, self.held_tau)

    def ask(self, cycles: int = 1, ahead: float = 0.0) -> np.ndarray:
        self.now += cycles * PERIOD
        self.session.hear(self._measured(cycles), self.now)
        values = self.session.answer(self.now, ahead)
        if self.session.state.wanted is CommandMode.TORQUE:
            self.held_tau = tuple(values)
        else:
            self.held = tuple(values)
        return values

    def command(self, end: float, speed: float, way: float, start: float, **torques: object) -> bool:
        """Give the session the command of a tick, at whose end the first joint is ``way`` [rad] away from ``Q``.

        Returns:
            True if the session takes the command.
        """
        first = np.eye(JOINTS)[0]
        q, v = np.array(Q) + way * first, speed * first
        command = ArmCommand(self.now, start, end, tuple(q), tuple(v), (ACCELERATION,) * JOINTS)
        for name, value in torques.items():
            setattr(command, name, value)
        return follow({"left": self.session}, {"left": command})

    def accelerate(self, until: float) -> tuple[float, float]:
        """Follow a reference that accelerates from rest.

        Returns:
            The reference's last time [s], and the first joint's displacement [rad].
        """
        start = end = self.now + 2 * TICK
        speed = way = 0.0
        while speed < until:
            end += TICK
            way += speed * TICK + 0.5 * ACCELERATION * TICK**2
            speed += ACCELERATION * TICK
            assert self.command(end, speed, way, end - TICK if end > start else start)
            self.ask()
            self.ask()
        return end, way


def test_an_arm_comes_to_rest_on_its_certified_stop_if_no_command_comes() -> None:
    arm = Arm()
    _, way = arm.accelerate(SPEED)
    for _ in range(200):
        last = arm.ask()
    assert last[0] - Q[0] == pytest.approx(way + SPEED**2 / (2.0 * ACCELERATION), rel=1e-2)
    assert arm.session.state.following
    arm.session.brake(arm.now)
    assert arm.session.is_still(arm.now)


def test_a_command_that_begins_before_the_time_of_the_last_answer_is_refused() -> None:
    arm = Arm()
    end, way = arm.accelerate(SPEED)
    for _ in range(20):
        arm.ask()
    assert not arm.command(end + TICK, SPEED, way + SPEED * TICK, end)


def test_an_arm_that_is_ahead_waits_for_the_other_arm() -> None:
    arm = Arm()
    arm.accelerate(SPEED)
    before = arm.session.state.answered
    for _ in range(500):
        arm.ask(ahead=0.05)
    # The rate of the arm's time falls by 0.1, at 0.4 per second, and stays at 0.9 until the end of the 0.5 s.
    assert arm.session.state.answered - before == pytest.approx(0.5 - 0.1 * (0.5 - 0.125), abs=0.001)


def test_an_arm_is_ahead_of_another_arm_by_the_difference_of_their_times() -> None:
    first, other = Arm(), Arm()
    first.accelerate(SPEED)
    other.accelerate(SPEED)
    for _ in range(30):
        first.ask()
    other.session.state.arrival = first.now
    sessions = {"left": first.session, "right": other.session}
    assert ahead_of_others(sessions, "left", first.now) == pytest.approx(0.03, abs=1.5 * PERIOD)
    assert ahead_of_others(sessions, "right", first.now) == 0.0
    assert other.session.state.behind == pytest.approx(0.03, abs=1.5 * PERIOD)


def test_a_reference_that_does_not_begin_at_the_arm_is_not_followed() -> None:
    arm = Arm()
    arm.command(arm.now + 2 * TICK, 0.0, 0.01, arm.now + TICK)
    arm.ask()
    assert not arm.session.state.following


def test_a_torque_that_is_not_updated_is_replaced_by_damping() -> None:
    arm = Arm(CommandMode.TORQUE)
    push, damping = (5.0,) * JOINTS, (10.0,) * JOINTS
    arm.command(arm.now + 2 * TICK, 0.0, 0.0, arm.now + TICK, tau=push, damping=damping)
    for _ in range(10):
        sent = arm.ask()
    np.testing.assert_allclose(sent, push)
    arm.v = (0.3,) * JOINTS
    for _ in range(40):
        sent = arm.ask()
    np.testing.assert_allclose(sent, -3.0)


def test_a_motion_that_the_robot_ended_counts_as_ended_only_once() -> None:
    arm = Arm()
    arm.accelerate(SPEED)
    arm.session.end("reflex")
    arm.session.end("reflex")
    assert arm.session.state.ended == 1
    assert arm.session.is_still(arm.now)
