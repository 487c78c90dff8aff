"""The simulated cabinet, with a client that is written in this file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.plants.fri.cabinet import Cabinet, CabinetSettings, StillArm, Trip
from q2r2_control.plants.fri.wire import (
    CommandKind,
    FriCommand,
    IoValue,
    Joints,
    Monitoring,
    Operation,
    Quality,
    Safety,
    Session,
    write_command,
    write_monitoring,
)

HOME = (0.0, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0)
SETTINGS = CabinetSettings(
    lower=(-2.0,) * 7, upper=(2.0,) * 7, velocity=(1.7,) * 7, acceleration=(10.0,) * 7, torque=(20.0,) * 7
)
Answer = Callable[[Monitoring], FriCommand | None]


class Client:
    """A client that mirrors the cabinet's position, as it must do before it may command."""

    def __init__(self, version: int = 2) -> None:
        self.version, self.counter = version, -1

    def answer(self, message: Monitoring, q: Joints | None = None, tau: Joints | None = None) -> FriCommand:
        self.counter += 1
        return FriCommand(self.counter, message.counter, q or message.ipo_q or message.q, tau)


def run(cabinet: Cabinet, periods: int, answer: Answer, version: int = 2) -> Monitoring:
    """Let the client answer for ``periods`` periods. Return the message that follows."""
    for period in range(periods):
        message = cabinet.send(period * cabinet.settings.period)
        if (command := answer(message)) is not None:
            cabinet.receive(write_command(command, version))
    return cabinet.send(periods * cabinet.settings.period)


def commanding(settings: CabinetSettings = SETTINGS) -> tuple[Cabinet, Client]:
    """Return a cabinet that a client commands."""
    cabinet, client = Cabinet(settings, StillArm(HOME)), Client(settings.version)
    cabinet.start_overlay()
    run(cabinet, 60 * settings.multiplier, client.answer, settings.version)
    assert cabinet.session is Session.COMMANDING_ACTIVE
    return cabinet, client


def test_with_punctual_answers_a_session_is_monitored_and_the_start_of_the_overlay_leads_to_commanding() -> None:
    cabinet, client = Cabinet(SETTINGS, StillArm(HOME)), Client()
    seen: list[Session] = []
    for period in range(200):
        if period == 100:
            cabinet.start_overlay()
        message = cabinet.send(0.0)
        if message.session not in seen[-1:]:
            seen.append(message.session)
            assert (message.ipo_q is not None) == (message.session >= Session.COMMANDING_WAIT)
        cabinet.receive(write_command(client.answer(message), 2))
    assert seen == list(Session)[1:]
    assert cabinet.quality is Quality.EXCELLENT


def test_with_wrong_load_data_no_client_may_command() -> None:
    cabinet, client = Cabinet(SETTINGS, StillArm(HOME)), Client()
    cabinet.load_fits = False
    cabinet.start_overlay()
    assert run(cabinet, 300, client.answer).session is Session.COMMANDING_WAIT
    cabinet.load_fits = True
    assert run(cabinet, 2, client.answer).session is Session.COMMANDING_ACTIVE


@pytest.mark.parametrize(("speed", "trips"), [(0.24, []), (0.26, [Trip.T1])])
def test_in_t1_a_command_of_more_than_250_mm_s_at_the_tool_ends_the_session(speed: float, trips: list[Trip]) -> None:
    cabinet, client = commanding(replace(SETTINGS, acceleration=(1e3,) * 7))
    cabinet.operation = Operation.T1

    def answer(message: Monitoring) -> FriCommand:
        assert message.ipo_q is not None
        return client.answer(message, tuple(q + speed * SETTINGS.period for q in message.ipo_q))

    for _ in range(5):
        if cabinet.session is Session.COMMANDING_ACTIVE:
            run(cabinet, 1, answer)
    assert cabinet.trips[:1] == trips


def test_a_client_that_answers_only_every_other_message_may_not_command() -> None:
    cabinet, client = Cabinet(SETTINGS, StillArm(HOME)), Client()
    cabinet.start_overlay()
    message = run(cabinet, 300, lambda message: client.answer(message) if message.counter % 2 else None)
    assert (message.session, message.quality) == (Session.MONITORING_WAIT, Quality.FAIR)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("multiplier", [1, 3])
def test_the_arm_moves_as_the_client_commands(version: int, multiplier: int) -> None:
    settings = replace(SETTINGS, version=version, multiplier=multiplier, period=0.002)
    cabinet, client = commanding(settings)
    period = settings.answer_period

    def swing(message: Monitoring) -> FriCommand | None:
        if message.counter % multiplier:
            return None
        t = (message.counter // multiplier) * period - begin
        return client.answer(message, (HOME[0] + 0.2 * (1.0 - math.cos(t)), *HOME[1:]))

    begin = math.ceil((cabinet._sent + 1) / multiplier) * period
    message = run(cabinet, 600, swing, version)
    assert cabinet.trips == []
    assert message.q[0] > HOME[0] + 0.01


def test_the_cabinet_waits_for_an_answer_only_after_messages_that_request_one() -> None:
    cabinet, client = Cabinet(replace(SETTINGS, multiplier=2), StillArm(HOME)), Client()
    waits = []
    for _ in range(4):
        message = cabinet.send(0.0)
        waits.append(not cabinet.is_answered)
        if message.counter % 2 == 0:
            cabinet.receive(write_command(client.answer(message), 2))
            assert cabinet.is_answered
    assert waits == [False, True] * 2


def moved(by: float) -> Joints:
    return (HOME[0] + by, *HOME[1:])


TORQUE = replace(SETTINGS, command=CommandKind.TORQUE)
GUARDS: dict[Trip, tuple[CabinetSettings, Callable[[Client, Monitoring], FriCommand | None]]] = {
    Trip.VELOCITY: (replace(SETTINGS, acceleration=(1e4,) * 7), lambda c, m: c.answer(m, moved(0.01))),
    Trip.ACCELERATION: (SETTINGS, lambda c, m: c.answer(m, moved(0.001))),
    Trip.POSITION: (replace(SETTINGS, upper=moved(1e-4)), lambda c, m: c.answer(m, moved(2e-4))),
    Trip.NO_POSITION: (SETTINGS, lambda c, m: FriCommand(c.answer(m).counter, m.counter)),
    Trip.NO_TORQUE: (TORQUE, lambda c, m: c.answer(m)),
    Trip.TORQUE: (TORQUE, lambda c, m: c.answer(m, tau=(21.0,) * 7)),
    Trip.LATE: (SETTINGS, lambda c, m: None),
}


@pytest.mark.parametrize("trip", list(GUARDS), ids=lambda trip: trip.name)
def test_an_answer_that_no_cabinet_would_follow_ends_the_session_and_the_arm_holds(trip: Trip) -> None:
    settings, answer = GUARDS[trip]
    kept = replace(settings, command=CommandKind.POSITION)
    cabinet, client = commanding(kept)
    cabinet.settings = settings
    message = run(cabinet, 20, lambda message: answer(client, message))
    assert cabinet.trips == [trip]
    assert message.session <= Session.MONITORING_READY
    assert message.q == HOME


def test_invalid_answers_and_answers_of_a_wrong_fri_version_end_the_session_and_a_late_answer_does_not_count() -> None:
    endless, nowhere = (math.inf,) * 7, (math.nan, *HOME[1:])
    for datagram, trip in (
        (b"hello", Trip.MALFORMED),
        # This datagram has the identifier of a message. An answer has another identifier.
        (write_monitoring(Cabinet(SETTINGS, StillArm(HOME)).send(0.0)), Trip.MALFORMED),
        (write_command(FriCommand(1, 1, q=nowhere), 2), Trip.MALFORMED),
        (write_command(FriCommand(1, 1, q=HOME, tau=endless), 2), Trip.MALFORMED),
        (write_command(FriCommand(1, 1, q=HOME), 1), Trip.VERSION),
    ):
        cabinet, _ = commanding()
        cabinet.receive(datagram)
        assert cabinet.trips == [trip]
    cabinet, client = commanding()
    run(cabinet, 20, lambda message: client.answer(replace(message, counter=message.counter - 1)))
    assert cabinet.trips == [Trip.LATE]


def test_missed_answers_are_counted_only_if_the_client_answers_again() -> None:
    cabinet, client = commanding()
    run(cabinet, 100, lambda message: client.answer(message) if message.counter % 20 else None)
    assert cabinet.missed == 6  # Five answers are missed in ``run``, and one after the last message in ``commanding``.
    run(cabinet, 20, lambda message: None)
    assert (cabinet.missed, cabinet.trips) == (6, [Trip.LATE])


def test_the_cabinets_own_position_stays_where_the_session_began_until_the_next_session() -> None:
    cabinet, client = commanding(replace(SETTINGS, acceleration=(1e3,) * 7))
    ways = iter(range(1, 101))
    message = run(cabinet, 100, lambda message: client.answer(message, moved(1e-3 * next(ways))))
    assert (message.ipo_q, message.q) == (HOME, moved(0.1))
    cabinet.stop()
    cabinet.start_overlay()
    message = run(cabinet, 2, client.answer)
    assert (message.session, message.ipo_q) == (Session.COMMANDING_ACTIVE, moved(0.1)), "the next session begins there"


@pytest.mark.parametrize(
    ("io", "trips", "outputs"),
    [
        ({"opening": 0.5}, [], {"opening": 0.5}),
        ({"elsewhere": 0.5}, [Trip.OUTPUT], {"opening": 1.0}),
        ({"measured": 0.5}, [Trip.OUTPUT], {"opening": 1.0}),
        ({"opening": True}, [Trip.OUTPUT], {"opening": 1.0}),
    ],
    ids=["listed", "not listed", "an input", "another kind"],
)
def test_an_answer_may_write_only_outputs_that_the_cabinet_lists(
    io: dict[str, IoValue], trips: list[Trip], outputs: dict[str, IoValue]
) -> None:
    cabinet, client = Cabinet(SETTINGS, StillArm(HOME), {"opening": 1.0}), Client()
    cabinet.inputs["measured"] = 1.0
    cabinet.start_overlay()
    run(cabinet, 60, client.answer)
    message = run(cabinet, 1, lambda message: replace(client.answer(message), io=io))
    assert (cabinet.trips, cabinet.outputs) == (trips, outputs)
    assert (message.io, message.outputs) == ({"measured": 1.0, **outputs}, {"opening"})


def test_torques_have_to_come_as_often_as_sunrise_requires() -> None:
    with pytest.raises(ConfigError, match="answered every 6 ms: allowed with torques: 5 ms or less"):
        replace(TORQUE, period=0.003, multiplier=2)


def test_torques_are_not_allowed_until_the_load_data_agree_with_the_load_of_the_arm() -> None:
    arm, client = StillArm(HOME), Client()
    arm.external_tau = (0.0, 2.1, *(0.0,) * 5)
    cabinet = Cabinet(TORQUE, arm)
    cabinet.start_overlay()
    tau = (1.0,) * 7
    assert run(cabinet, 300, lambda message: client.answer(message, tau=tau)).session is Session.COMMANDING_WAIT
    arm.external_tau = (0.0, -1.9, *(0.0,) * 5)
    assert run(cabinet, 10, client.answer).session is Session.COMMANDING_WAIT, "nor before torques come"
    message = run(cabinet, 2, lambda message: client.answer(message, tau=tau))
    assert (message.session, message.commanded_tau) == (Session.COMMANDING_ACTIVE, tau)


def test_after_a_stop_the_overlay_has_to_start_again_and_the_safety_stop_has_to_be_over() -> None:
    cabinet, client = commanding()
    cabinet.safety_stop(Safety.STOP_2)
    cabinet.start_overlay()
    assert run(cabinet, 100, client.answer).session is Session.MONITORING_READY
    cabinet.safety_stop(Safety.NORMAL)
    assert run(cabinet, 100, client.answer).session is Session.COMMANDING_ACTIVE
    assert cabinet.trips == [Trip.SAFETY]
