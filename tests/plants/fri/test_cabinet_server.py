"""The cell behind the cabinets that stand in: it moves as they are commanded."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.plants.fri.cabinet_server import CabinetServer, Network, SimulatedArms, settings_of
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.wire import LONGEST, CommandKind, Session
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES
from tests.plants.fri.conftest import PATIENCE

PERIOD = 0.005


@pytest.mark.parametrize("overlay", [None, (0.0,) * 7], ids=["position", "torque"])
def test_an_arm_goes_where_its_cabinet_commands_and_the_other_one_stays(
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


def test_the_guards_leave_the_reference_room_for_catching_up(robot: Robot) -> None:
    settings = settings_of(robot, "left", CommandKind.POSITION, 2, PERIOD)
    joints = robot.arms["left"].joints
    assert (np.array(settings.acceleration) > 1.1 * robot.acceleration_limit[joints]).all()
    assert settings.velocity == tuple(robot.velocity_limit[joints])


def test_an_arm_moves_on_at_the_end_of_its_way_where_the_next_command_comes(config: Config, robot: Robot) -> None:
    cell = SimulatedArms(robot, config)
    cell.arms["left"].advance(PERIOD, tuple(np.array(cell.arms["left"].q) + 0.01), None)
    for t, speed in ((0.5 * PERIOD, 0.01 / PERIOD), (PERIOD, 0.01 / PERIOD), (1.5 * PERIOD, 0.0)):
        np.testing.assert_allclose(cell.arms["left"].wanted(t)[1], speed)


def test_cabinets_that_were_late_catch_up_as_fast_as_they_are_answered(fri_config: Config, robot: Robot) -> None:
    cell, plant = SimulatedArms(robot, fri_config), FriPlant.from_config(robot, fri_config)
    settings = {arm: settings_of(robot, arm, CommandKind.POSITION, 2, PERIOD) for arm in SIDES}
    clients = {str(arm): ("127.0.0.1", its.port) for arm, its in fri_config.fri.items()}
    server = CabinetServer(cell, settings, clients, {}, Network())
    slept = caught_up = False

    def look(due: float) -> None:
        nonlocal slept, caught_up
        caught_up = slept and time.monotonic() - server._began - due < 0.01
        if not slept and all(one.session is Session.COMMANDING_ACTIVE for one in server.cabinets.values()):
            time.sleep(0.2)  # this process stands still for a moment
            slept = True

    for cabinet in server.cabinets.values():
        cabinet.start_overlay()
    serving = threading.Thread(target=server.run, args=(lambda now: caught_up or now > PATIENCE, look))
    serving.start()
    try:
        plant.reset()  # which answers, in a thread of its own
        serving.join()
    finally:
        plant.close()
    assert caught_up


def test_an_answer_that_came_while_the_cabinet_stood_still_is_heard(config: Config, robot: Robot) -> None:
    settings = {"left": settings_of(robot, "left", CommandKind.POSITION, 2, PERIOD)}
    session = ArmSession("left", "cabinet")
    with socket.socket(type=socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.setblocking(False)
        server = CabinetServer(SimulatedArms(robot, config), settings, {"left": client.getsockname()}, {}, Network())
        (cabinet,) = server.cabinets.values()
        answers = 0

        def answer(now: float) -> bool:
            """Answers what was sent; then this process stands still until the next message is due."""
            nonlocal answers
            with suppress(BlockingIOError):
                datagram, source = client.recvfrom(LONGEST)
                if (reply := session.answer(datagram, now)) is not None:
                    client.sendto(reply, source)
                    answers += 1
                    time.sleep(1.5 * PERIOD)
            return answers > 150 or now > PATIENCE

        cabinet.start_overlay()
        server.run(answer)
    assert (cabinet.session, cabinet.missed) == (Session.COMMANDING_ACTIVE, 0)
