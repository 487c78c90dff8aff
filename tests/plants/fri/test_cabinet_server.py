"""The simulated cell moves as its simulated cabinets are commanded."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.errors import ProtocolError
from q2r2_control.plants.fri.cabinet import Trip
from q2r2_control.plants.fri.cabinet_server import CabinetServer, Network, SimulatedArms, settings_of
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.session_state import SessionState
from q2r2_control.plants.fri.wire import LONGEST, CommandKind, Session, joints_of, read_monitoring
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES
from tests.plants.fri.conftest import PATIENCE

PERIOD = 0.005
PERFECT = Network()


@pytest.mark.parametrize("overlay", [None, (0.0,) * 7], ids=["position", "torque"])
def test_an_arm_moves_as_its_cabinet_commands_while_the_other_arm_stays(
    config: Config, robot: Robot, overlay: tuple[float, ...] | None
) -> None:
    cell = SimulatedArms(robot, config)
    start = {arm: np.array(cell.arms[arm].q) for arm in SIDES}
    for tick in range(1, 201):
        goal = start["left"] + np.array([0.1 * min(tick, 100) / 100, 0, 0, 0, 0, 0, 0])
        cell.advance(tick * PERIOD)
        cell.arms["left"].advance(PERIOD, tuple(goal), None)
        cell.arms["right"].advance(PERIOD, tuple(start["right"]), overlay)
    np.testing.assert_allclose(cell.arms["left"].q, start["left"] + [0.1, 0, 0, 0, 0, 0, 0], atol=0.01)
    np.testing.assert_allclose(cell.arms["right"].q, start["right"], atol=0.02)


@pytest.mark.parametrize("stiffness", [0.0, 100.0])
def test_torque_commands_are_added_to_the_joint_impedance(config: Config, robot: Robot, stiffness: float) -> None:
    cell = SimulatedArms(robot, config, stiffness)
    joints = robot.arms["left"].joints
    start, tau = robot.home[joints], np.array([5.0, *np.zeros(6)])
    for tick in range(1, 301):
        cell.arms["left"].advance(0.005, joints_of(start), joints_of(tau))
        cell.advance(0.005 * tick)
    turned = cell.state.q[joints] - start
    if stiffness:
        np.testing.assert_allclose(turned, tau / stiffness, atol=2e-3)
    else:
        assert turned[0] > 0.5


def test_the_cabinets_limits_allow_the_reference_to_catch_up(robot: Robot) -> None:
    settings = settings_of(robot, "left", CommandKind.POSITION, 2, PERIOD)
    joints = robot.arms["left"].joints
    assert (np.array(settings.acceleration) > 1.1 * robot.acceleration_limit[joints]).all()
    assert settings.velocity == tuple(robot.velocity_limit[joints])


def test_the_drives_keep_their_velocity_until_the_next_command_is_due(config: Config, robot: Robot) -> None:
    cell = SimulatedArms(robot, config)
    cell.arms["left"].advance(PERIOD, tuple(np.array(cell.arms["left"].q) + 0.01), None)
    for t, speed in ((0.5 * PERIOD, 0.01 / PERIOD), (PERIOD, 0.01 / PERIOD), (1.5 * PERIOD, 0.0)):
        np.testing.assert_allclose(cell.arms["left"].wanted(t)[1], speed)


class Answered:
    """A started cabinet and its client in the same thread, so that a busy computer changes nothing."""

    def __init__(self, config: Config, robot: Robot, network: Network = PERFECT) -> None:
        settings = {"left": settings_of(robot, "left", CommandKind.POSITION, 2, PERIOD)}
        self._session, self.answers = ArmSession("left", "cabinet"), 0
        self.counters: list[int] = []  # Counters of the messages that came.
        self._client = socket.socket(type=socket.SOCK_DGRAM)
        self._client.bind(("127.0.0.1", 0))
        self._client.setblocking(False)
        address = self._client.getsockname()
        origin = {"left": ("127.0.0.1", 0)}
        self.server = CabinetServer(SimulatedArms(robot, config), settings, origin, {"left": address}, {}, network)
        (self.cabinet,) = self.server.cabinets.values()
        self.cabinet.start_overlay()

    @property
    def state(self) -> SessionState:
        return self._session.state

    def answer(self, now: float) -> bool:
        """Answer the next message. Return False if no message had come."""
        try:
            datagram, source = self._client.recvfrom(LONGEST)
        except BlockingIOError:
            return False
        with suppress(ProtocolError):
            self.counters.append(read_monitoring(datagram).counter)
        if (reply := self._session.answer(datagram, now)) is None:
            return False
        self._client.sendto(reply, source)
        self.answers += 1
        return True

    def run(self, until: Callable[[float], bool]) -> None:
        with self._client:
            self.server.run(lambda now: until(now) or now > PATIENCE)


def test_a_late_cabinet_catches_up_as_fast_as_it_gets_answers(config: Config, robot: Robot) -> None:
    one, sent = Answered(config, robot), [0.0]

    def until(now: float) -> bool:
        if one.answer(now):
            sent.append(now)
            if one.answers == 100:
                time.sleep(0.2)  # This process stands still for a moment.
        return one.answers > 120

    one.run(until)
    assert one.cabinet.session is Session.COMMANDING_ACTIVE
    assert np.diff(sent[102:]).min() < 0.8 * PERIOD


def test_an_answer_that_came_while_the_cabinet_stood_still_is_used(config: Config, robot: Robot) -> None:
    one = Answered(config, robot)

    def until(now: float) -> bool:
        if one.answer(now):
            time.sleep(1.5 * PERIOD)  # Wait until the next message is due.
        return one.answers > 150

    one.run(until)
    assert (one.cabinet.session, one.cabinet.missed) == (Session.COMMANDING_ACTIVE, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "faults"),
    [
        pytest.param(PERFECT, (False, False, False), id="perfect"),
        pytest.param(Network(loss=0.05), (True, False, False), id="loss"),
        pytest.param(Network(duplicate=0.1), (False, True, False), id="duplicates"),
        pytest.param(Network(jitter=1.5 * PERIOD), (False, False, True), id="jitter"),
    ],
)
def test_messages_are_lost_doubled_and_reordered_as_the_network_options_say(
    config: Config, robot: Robot, network: Network, faults: tuple[bool, bool, bool]
) -> None:
    one = Answered(config, robot, network)
    one.run(lambda now: one.answer(now) and len(one.counters) > 200)
    counters, came = one.counters, set(one.counters)
    # The last messages are not checked, because they may still be on their way.
    is_lost = not came.issuperset(range(1, max(came) - 5))
    assert (is_lost, len(came) < len(counters), counters != sorted(counters)) == faults
    if network.loss:
        assert one.cabinet.missed > 0, "answers are lost too"


def test_a_truncated_message_is_not_answered_and_a_truncated_answer_ends_the_session(
    config: Config, robot: Robot
) -> None:
    one = Answered(config, robot, Network(cut=0.02))

    def until(now: float) -> bool:
        # While a session is monitored, a truncated answer ends only the overlay. The overlay then has to start again.
        one.cabinet.start_overlay()
        return one.answer(now) and bool(one.cabinet.trips) and one.state.unreadable > 0

    one.run(until)
    assert set(one.cabinet.trips) == {Trip.MALFORMED}
