"""A cabinet is silent for a while, or becomes idle, in the middle of a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.plants.fri.answers import CATCH_UP, CATCH_UP_RAMP
from q2r2_control.plants.fri.session_state import ArmCommand
from q2r2_control.plants.fri.wire import Monitoring, Session
from tests.plants.fri.asking_cabinet import ACTIVE, IPO, MONITORING, WAITING, Cabinet, Q


@pytest.mark.parametrize("silence", [0.15, 6.0])
@pytest.mark.parametrize("loop", ["goes on", "stands still"])
def test_if_a_cabinet_is_silent_during_motion_its_arm_brakes_as_certified_and_follows_only_from_rest(
    silence: float, loop: str
) -> None:
    cabinet, ones, still = Cabinet(), (1.0,) * 7, (0.0,) * 7
    session, followed = cabinet.session, list[tuple[float, ...]]()

    def command(way: float, speed: float) -> None:
        there, end = tuple(q + way for q in IPO), cabinet.now + 0.003
        session.follow(ArmCommand(cabinet.now, end - 0.005, end, there, (speed,) * 7, ones))

    def follows() -> bool:
        return session.state.following

    def ask() -> None:
        answer = cabinet.ask(ACTIVE)
        assert answer is not None
        assert answer.q is not None
        followed.append(answer.q)

    cabinet.ask(WAITING)
    cabinet.ask(ACTIVE)
    for t in np.linspace(0.005, 0.1, 20):  # The reference accelerates from the posture IPO at 1 rad/s^2.
        command(0.5 * t**2, t)
        ask()
    assert follows()
    if loop == "stands still":
        cabinet.silence = silence
    while cabinet.silence < silence:  # The reference goes on at this speed, while no message comes.
        cabinet.silence += 0.005
        command(0.005 + 0.1 * cabinet.silence, 0.1)
    ask()
    assert not follows()
    assert not session.is_still(cabinet.now)
    for _ in range(100):  # A new reference begins at the posture in which the braking arm will rest.
        now, rest = cabinet.now, session.state.rest
        session.follow(ArmCommand(now, now - 0.002, now + 0.003, rest, still, ones))
        ask()
    accelerations = np.diff(followed, n=2, axis=0) / 0.005**2
    assert np.abs(accelerations).max() <= (1.0 + CATCH_UP) ** 2 + CATCH_UP_RAMP * 0.1
    assert np.subtract(followed[-1], followed[19]).max() < 0.5 * 0.1**2 + 1e-3, "it brakes at once"
    np.testing.assert_allclose(followed[-1], session.state.rest, atol=1e-9)
    assert follows()
    assert session.state.ended == 1


@pytest.mark.parametrize(
    "after",
    [
        pytest.param(replace(ACTIVE, version=1, ipo_q=Q), id="other version"),
        pytest.param(replace(ACTIVE, ipo_q=Q), id="counter began anew"),
    ],
)
def test_a_session_that_restarted_during_a_silence_gets_the_cabinets_own_position(after: Monitoring) -> None:
    cabinet = Cabinet()
    cabinet.sent = 10
    cabinet.ask(WAITING)
    cabinet.ask(ACTIVE)
    cabinet.silence = 0.2
    if after.version == 2:
        cabinet.sent, cabinet.silence = 0, 0.3
    answer = cabinet.ask(after)
    assert answer is not None
    assert answer.q == pytest.approx(Q, abs=1e-15)


def test_if_a_cabinet_becomes_idle_during_motion_its_arm_is_not_moved_any_more() -> None:
    cabinet = Cabinet()
    cabinet.ask(WAITING)
    cabinet.ask(ACTIVE)
    now, ones = cabinet.now, (1.0,) * 7
    cabinet.session.follow(ArmCommand(now, now - 0.002, now + 0.003, IPO, (0.005,) * 7, ones))
    assert not cabinet.session.is_still(now)
    assert cabinet.ask(replace(MONITORING, session=Session.IDLE)) is None
    assert cabinet.session.is_still(cabinet.now)
