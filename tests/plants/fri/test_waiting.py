"""A wait for cabinets, with a simulated clock."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from q2r2_control.plants.fri.session_state import SessionState
from q2r2_control.plants.fri.waiting import CabinetWait, what_is_missing
from q2r2_control.plants.fri.wire import Session
from tests.plants.fri.asking_cabinet import ACTIVE, MONITORING

SILENT = SessionState("left", "cabinet 192.0.2.1 on port 30200")


class Clock:
    """A clock that advances by a second each time it is read."""

    now = -1.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


@pytest.fixture(autouse=True)
def _no_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("q2r2_control.plants.fri.waiting.time.sleep", lambda seconds: None)


def waited(longest: float, ready_after: float = math.inf, stopped_after: float = math.inf) -> tuple[bool, float]:
    clock = Clock()
    waiting = CabinetWait(lambda: clock.now >= stopped_after, clock)
    return waiting.until(lambda: clock.now >= ready_after, lambda: [SILENT], longest), clock.now


def test_a_wait_lasts_until_cabinets_are_ready_or_its_time_is_over_or_it_is_stopped() -> None:
    assert waited(math.inf, ready_after=70.0) == (True, 70.0)
    assert waited(60.0) == (False, 60.0)
    assert waited(math.inf, stopped_after=5.0) == (False, 5.0)


def test_a_wait_logs_its_cabinets_and_its_duration_every_ten_seconds(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    waited(34.0)
    lines = [entry.getMessage() for entry in caplog.records]
    assert [line.partition(":")[0] for line in lines] == ["waits", *(f"waits still, for {t} s" for t in (13, 23, 33))]
    assert "left: no FRI message from cabinet 192.0.2.1 on port 30200 of this computer; start its FRI" in lines[0]


def test_nothing_is_logged_if_the_cabinets_are_ready_soon(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    waited(math.inf, ready_after=2.0)
    assert caplog.records == []


@pytest.mark.parametrize(
    ("session", "told"),
    [
        (
            Session.MONITORING_WAIT,
            "in monitoring wait, connection excellent, drives active; the connection is not good",
        ),
        (Session.MONITORING_READY, "let its application start the overlay"),
        (Session.COMMANDING_WAIT, "whether the load data are those of the tool"),
    ],
)
def test_the_instruction_for_the_operator_depends_on_the_session(session: Session, told: str) -> None:
    state = replace(SILENT, newest=replace(MONITORING, session=session), arrival=10.0)
    assert told in what_is_missing(state, 10.0)
    assert "no FRI message" in what_is_missing(state, 11.0)


def test_the_problem_of_an_unreadable_message_is_reported_unchanged() -> None:
    state = replace(SILENT, newest=ACTIVE, arrival=10.0, problem="FRI 2 datagram whose checksum is wrong")
    assert what_is_missing(state, 11.0).endswith("30200: FRI 2 datagram whose checksum is wrong")
