"""One cabinet's session: the messages that are answered, and those that are refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.plants.fri.answers import CATCH_UP, CATCH_UP_RAMP
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.plants.fri.session import ArmSession, follow
from q2r2_control.plants.fri.session_state import ArmCommand
from q2r2_control.plants.fri.wire import CommandKind, FriCommand, Joints, Monitoring, Safety, Session, write_monitoring
from q2r2_control.wording import sentence
from tests.plants.fri.asking_cabinet import ACTIVE, IPO, MONITORING, WAITING, Cabinet, Q

FAR = (0.3, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0)  # A client has moved the arm to this posture.


def test_an_idle_cabinet_gets_no_answer_and_a_monitoring_cabinet_gets_an_answer_without_a_position() -> None:
    cabinet = Cabinet()
    assert cabinet.ask(replace(MONITORING, session=Session.IDLE)) is None
    assert cabinet.ask(MONITORING) == FriCommand(0, 2)


def test_a_monitoring_cabinet_with_fri_1_gets_its_own_commanded_position_back() -> None:
    cabinet = Cabinet()
    answer = cabinet.ask(replace(MONITORING, version=1, commanded_q=IPO))
    assert answer is not None
    assert answer.q == IPO


@pytest.mark.parametrize(
    ("message", "q"),
    [
        pytest.param(WAITING, IPO, id="waiting"),
        pytest.param(ACTIVE, Q, id="already active"),
        pytest.param(replace(ACTIVE, version=1, commanded_q=FAR), FAR, id="already active, FRI 1"),
    ],
)
def test_the_first_command_is_the_posture_that_the_cabinet_holds_or_to_which_another_client_moved_it(
    message: Monitoring, q: Joints
) -> None:
    cabinet = Cabinet()
    cabinet.ask(replace(MONITORING, version=message.version))
    answer = cabinet.ask(message)
    assert answer is not None
    assert answer.q == pytest.approx(q, abs=1e-15)


@pytest.mark.parametrize("message", [MONITORING, ACTIVE], ids=["monitoring", "active"])
def test_only_outputs_that_the_cabinet_has_are_written_in_its_own_type(message: Monitoring) -> None:
    cabinet, ones = Cabinet(), (1.0,) * 7
    wanted = {"opening": 0.25, "open": True, "light": False, "elsewhere": 0.5, "measured": 0.5, "digital": 0.5}
    cabinet.ask(WAITING)
    cabinet.session.follow(ArmCommand(cabinet.now, cabinet.now, cabinet.now + 0.002, IPO, (0.0,) * 7, ones, wanted))
    io = {"opening": 1.0, "open": False, "light": 7, "measured": 1.0, "digital": False}
    answer = cabinet.ask(replace(message, io=io, outputs=frozenset(io) - {"measured"}))
    assert answer is not None
    assert answer.io == {"opening": 0.25, "open": True, "light": 0}
    assert isinstance(answer.io["open"], bool)


def test_with_a_multiplier_of_three_only_each_third_message_is_answered() -> None:
    cabinet = Cabinet()
    answers = [cabinet.ask(replace(MONITORING, multiplier=3)) for _ in range(6)]
    assert [answer is None for answer in answers] == [True, True, False, True, True, False]


def torque_cabinet(limit: float = 100.0, rate: float = math.inf) -> Cabinet:
    limits = np.full(7, limit)
    return Cabinet(ArmSession("left", "cabinet", None, CommandKind.TORQUE, limits, torque_rate_limit=rate))


def begin_torques(cabinet: Cabinet) -> Monitoring:
    """Begin a session with torques and one command. Return the message of the active session."""
    active = replace(ACTIVE, command=CommandKind.TORQUE)
    cabinet.ask(replace(WAITING, command=CommandKind.TORQUE))
    cabinet.ask(active)
    now, overlay, still, damping = cabinet.now, (1.0,) * 7, (0.0,) * 7, (20.0,) * 7
    cabinet.session.follow(ArmCommand(now, now, now + 0.002, Q, still, overlay, {}, overlay, damping))
    cabinet.session.state.velocity = (0.2,) * 7
    return active


def test_an_answer_with_torques_repeats_the_cabinets_own_position() -> None:
    cabinet = torque_cabinet()
    answer = cabinet.ask(begin_torques(cabinet))
    assert answer is not None
    assert (answer.q, answer.tau) == (IPO, (1.0,) * 7)


def test_a_torque_that_is_not_updated_is_replaced_by_a_braking_torque_and_later_no_answer_is_sent() -> None:
    cabinet = torque_cabinet()
    active = begin_torques(cabinet)
    q = iter(np.linspace(Q, np.add(Q, 0.025), 26)[1:])  # The joints move at 0.2 rad/s.
    answers = [cabinet.ask(replace(active, q=tuple(next(q).tolist()))) for _ in range(25)]
    torques = [answer and answer.tau and round(answer.tau[0], 3) for answer in answers]
    assert torques == [1.0] * 4 + [-4.0] * 16 + [None] * 5


def test_a_braking_torque_changes_no_faster_than_the_rate_limit_which_counts_as_at_least_5000_nm_s() -> None:
    for rate, change in ((6000.0, 30.0), (100.0, 25.0)):
        cabinet = torque_cabinet(rate=rate)
        active, still, ones = begin_torques(cabinet), (0.0,) * 7, (1.0,) * 7
        now = cabinet.now
        cabinet.session.follow(ArmCommand(now, now, now + 0.005, Q, still, ones, {}, None, (400.0,) * 7))
        answers = [cabinet.ask(replace(active, q=tuple(np.add(Q, 0.001 * tick).tolist()))) for tick in range(1, 7)]
        torques = [answer.tau[0] for answer in answers if answer and answer.tau]
        assert np.diff([0.0, *torques]).min() == pytest.approx(-change)
        assert torques[-1] == pytest.approx(-80.0)


def test_a_session_sends_braking_torques_as_long_as_commands_without_torques_come() -> None:
    cabinet = torque_cabinet()
    active = begin_torques(cabinet)
    for q in np.linspace(Q, np.add(Q, 0.1), 101)[1:]:  # The joints move at 0.2 rad/s.
        now, still = cabinet.now, (0.0,) * 7
        cabinet.session.follow(ArmCommand(now, now, now + 0.005, Q, still, (1.0,) * 7, {}, None, (20.0,) * 7))
        answer = cabinet.ask(replace(active, q=tuple(q.tolist())))
        assert answer is not None
        assert answer.tau == pytest.approx((-4.0,) * 7)


def test_a_jump_of_the_measured_position_counts_as_at_most_the_velocity_limit() -> None:
    limits = np.full(7, 100.0), np.full(7, 2.0)
    cabinet = Cabinet(ArmSession("left", "cabinet", None, CommandKind.TORQUE, *limits))
    for q in (Q, np.add(Q, 0.5), np.add(Q, -0.5)):
        cabinet.ask(replace(MONITORING, q=tuple(np.asarray(q).tolist())))
    assert cabinet.session.state.velocity == pytest.approx((0.5 * (0.5 * 2.0 - 2.0),) * 7)


def test_no_torque_is_beyond_the_limit() -> None:
    cabinet = torque_cabinet(limit=0.5)
    active = begin_torques(cabinet)
    answer = cabinet.ask(active)
    assert answer is not None
    assert answer.tau == (0.5,) * 7


def test_torques_are_refused_for_a_cabinet_whose_period_is_too_long() -> None:
    cabinet = torque_cabinet()
    begin_torques(cabinet)
    assert cabinet.ask(replace(WAITING, command=CommandKind.TORQUE, multiplier=2)) is None
    fault = cabinet.session.state.fault(cabinet.now)
    assert fault is not None
    assert sentence(fault) == "left: the cabinet asks every 10 ms; allowed for torques: 5 at most"


def test_the_end_of_a_session_is_a_fault_and_the_arm_no_longer_follows() -> None:
    cabinet = Cabinet()
    cabinet.ask(WAITING)
    cabinet.ask(ACTIVE)
    cabinet.session.state.following = True
    assert cabinet.session.state.fault(cabinet.now) is None
    cabinet.ask(MONITORING)
    assert cabinet.session.state.ended == 1
    assert not cabinet.session.state.following
    fault = cabinet.session.state.fault(cabinet.now)
    assert fault is not None
    assert fault.kind is FriReason.FRI_SESSION
    assert fault.detail["session"] == "monitoring ready"


def test_if_the_command_of_one_arm_is_late_both_commands_are_refused_and_both_arms_stop_as_certified() -> None:
    cabinet, still, ones = Cabinet(), (0.0,) * 7, (1.0,) * 7
    cabinet.ask(WAITING)
    cabinet.ask(ACTIVE)
    for _ in range(10):  # The reference accelerates from the posture IPO at 1 rad/s^2 for 50 ms.
        end = cabinet.now + 0.003
        passed = end - 0.013
        way, speed = 0.5 * passed**2, passed
        there = tuple(q + way for q in IPO)
        cabinet.session.follow(ArmCommand(cabinet.now, end - 0.005, end, there, (speed,) * 7, ones))
        cabinet.ask(ACTIVE)
    state = cabinet.session.state
    assert state.following
    late = ArmCommand(cabinet.now, state.answered - 1e-3, cabinet.now, IPO, still, ones)
    other = ArmSession("right", "cabinet")
    other.state.following = True
    assert not follow({"right": other, "left": cabinet.session}, {"right": late, "left": late})
    assert other.path.end == 0.0
    answers = [cabinet.ask(ACTIVE) for _ in range(40)]
    stop = np.array([answer.q for answer in answers if answer and answer.q])
    assert np.diff(stop, axis=0).min() >= 0.0, "it goes on, slower and slower"
    np.testing.assert_allclose(stop[-1], state.rest, atol=1e-9)
    # A reference that begins at this posture of rest is followed again.
    now = cabinet.now
    assert follow({"left": cabinet.session}, {"left": ArmCommand(now, now, now + 0.002, state.rest, still, ones)})
    assert cabinet.session.path.end == now + 0.002


def test_if_an_arm_rests_while_its_answers_still_catch_up_it_begins_to_move_again_without_a_jump() -> None:
    cabinet, fives, a = Cabinet(), (5.0,) * 7, 5.0
    cabinet.ask(WAITING)
    followed: list[tuple[float, ...]] = [IPO, IPO]
    cabinet.ask(ACTIVE)
    state, begun = cabinet.session.state, cabinet.now

    def ask() -> None:
        answer = cabinet.ask(ACTIVE)
        assert answer is not None
        assert answer.q is not None
        followed.append(answer.q)

    def command(start: float, end: float, way: float, speed: float) -> None:
        there = tuple(q + way for q in IPO)
        assert not cabinet.session.has_passed(ArmCommand(cabinet.now, start, end, there, (speed,) * 7, fives))
        cabinet.session.follow(ArmCommand(cabinet.now, start, end, there, (speed,) * 7, fives))

    for tick in range(1, 21):  # The motion has 50 ms of acceleration and 50 ms of braking.
        t, end = 0.005 * tick, cabinet.now + 0.003
        way, speed = (0.5 * a * t**2, a * t) if tick <= 10 else (0.0125 - 0.5 * a * (0.1 - t) ** 2, a * (0.1 - t))
        command(end - 0.005, end, way, speed)
        if 8 <= tick <= 13:
            cabinet.sent += 1  # This message is lost.
        else:
            ask()
    while np.abs(np.subtract(followed[-1], state.rest)).max() > 1e-12:
        ask()
        assert cabinet.now < begun + 1.0
    start = state.answered + 1e-4
    for t in (0.0, 0.002, 0.004):  # These are ticks of the loop before the next message.
        command(start + t, start + t + 0.002, 0.0125 + 0.5 * a * (t + 0.002) ** 2, a * (t + 0.002))
    for _ in range(10):
        ask()
    accelerations = np.diff(followed, n=2, axis=0) / 0.005**2
    assert np.abs(accelerations).max() <= (1.0 + CATCH_UP) ** 2 * a + CATCH_UP_RAMP * a * 0.05


def test_if_an_arm_begins_to_move_while_answers_are_lost_it_begins_from_rest() -> None:
    cabinet, fives, a = Cabinet(), (5.0,) * 7, 5.0
    cabinet.ask(WAITING)
    cabinet.ask(ACTIVE)
    begun = cabinet.now
    followed: list[tuple[float, ...]] = [IPO, IPO]
    for tick in range(1, 31):
        t, end = max(0.005 * (tick - 4), 0.0), cabinet.now + 0.003
        there = tuple(q + 0.5 * a * t**2 for q in IPO)
        cabinet.session.follow(ArmCommand(cabinet.now, end - 0.005, end, there, (a * t,) * 7, fives))
        # The first answers are lost. As long as the arm rests, the times that the answers are for may jump.
        lost = tick <= 10
        answer = cabinet.ask(ACTIVE, lost)
        assert answer is not None
        assert answer.q is not None
        if not lost:
            followed.append(answer.q)
    assert cabinet.session.state.following
    assert cabinet.session.state.answered > begun + 0.05
    accelerations = np.diff(followed, n=2, axis=0) / 0.005**2
    assert np.abs(accelerations).max() <= (1.0 + CATCH_UP) ** 2 * a + CATCH_UP_RAMP * a * 0.15


def test_a_cabinet_that_is_silent_or_asks_for_a_wrong_kind_of_commands_is_a_fault() -> None:
    cabinet = Cabinet()
    kinds = []
    for now in (0.0, 0.3):
        fault = cabinet.session.state.fault(now)
        kinds.append(None if fault is None else fault.kind)
        cabinet.ask(replace(ACTIVE, command=CommandKind.TORQUE))
    fault = cabinet.session.state.fault(cabinet.now)
    assert kinds == [FriReason.FRI_SILENT, FriReason.FRI_SILENT]
    assert fault is not None
    assert fault.kind is FriReason.FRI_COMMAND_MODE


@pytest.mark.parametrize("stop", [Safety.STOP_0_OR_1, Safety.STOP_1_ON_PATH, Safety.STOP_2])
def test_a_stop_of_the_safety_controller_is_a_fault_while_the_session_goes_on(stop: Safety) -> None:
    cabinet = Cabinet()
    for message in (MONITORING, WAITING, ACTIVE):
        cabinet.ask(message)
    assert cabinet.session.state.fault(cabinet.now) is None
    cabinet.ask(replace(ACTIVE, safety=stop))
    fault = cabinet.session.state.fault(cabinet.now)
    assert fault is not None
    assert fault.kind is FriReason.FRI_SESSION


def test_an_older_message_is_not_answered_and_lost_messages_are_counted() -> None:
    cabinet = Cabinet()
    for _ in range(3):
        cabinet.ask(MONITORING)
    cabinet.sent = 0
    assert cabinet.ask(MONITORING) is None
    cabinet.sent = 6
    assert cabinet.ask(MONITORING) is not None
    assert cabinet.session.state.lost == 3


def test_a_repeated_message_gets_the_same_answer_and_moves_nothing() -> None:
    cabinets, ones = {doubled: Cabinet() for doubled in (False, True)}, (1.0,) * 7
    heard: dict[bool, list[object]] = {False: [], True: []}
    for doubled, cabinet in cabinets.items():
        cabinet.ask(WAITING)
        cabinet.ask(ACTIVE)
        for t in np.linspace(0.005, 0.1, 20):  # The reference accelerates from the posture IPO at 1 rad/s^2.
            end, there = cabinet.now + 0.003, tuple(q + 0.5 * t**2 for q in IPO)
            cabinet.session.follow(ArmCommand(cabinet.now, end - 0.005, end, there, (t,) * 7, ones))
            answer = cabinet.ask(replace(ACTIVE, q=there), doubled=doubled)
            assert answer is not None
            heard[doubled].append((answer.reflected, answer.q, cabinet.session.state.velocity))
        assert cabinet.session.state.lost == 0
    assert heard[True] == heard[False]


def test_a_cabinet_whose_version_differs_from_the_version_in_the_yaml_is_reported_and_gets_no_answer() -> None:
    cabinet = Cabinet(ArmSession("left", "cabinet", version=1))
    assert cabinet.ask(MONITORING) is None
    fault = cabinet.session.state.fault(cabinet.now)
    assert fault is not None
    assert sentence(fault) == "left: cabinet: FRI 2: allowed by the YAML: 1"


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(write_monitoring(MONITORING)[:-1], id="cut"),
        pytest.param(write_monitoring(replace(MONITORING, counter=400)), id="counter far ahead"),
        pytest.param(write_monitoring(replace(MONITORING, counter=2, version=1)), id="other version"),
        pytest.param(write_monitoring(replace(MONITORING, counter=2, period=0.0)), id="no period"),
        pytest.param(b"", id="empty"),
    ],
)
def test_a_message_that_cannot_come_from_the_cabinet_changes_nothing(wrong: bytes) -> None:
    cabinet = Cabinet()
    cabinet.ask(MONITORING)
    before = cabinet.session.state.newest
    assert cabinet.session.answer(wrong, cabinet.now + 0.005) is None
    assert cabinet.session.state.newest is before
    assert cabinet.session.state.unreadable == 1


@pytest.mark.slow
def test_a_hundred_thousand_wrong_datagrams_raise_nothing() -> None:
    random = np.random.default_rng(0)
    session = ArmSession("left", "cabinet")
    whole = [write_monitoring(replace(message, version=version)) for message in (WAITING, ACTIVE) for version in (1, 2)]
    for index in range(100_000):
        wrong = bytearray(whole[index % 4])
        for place in random.integers(0, len(wrong), 1 + index % 3):
            wrong[place] = random.integers(0, 256)
        session.answer(bytes(wrong[: None if index % 5 else random.integers(0, len(wrong))]), 1e-3 * index)
    assert session.state.unreadable > 50_000
