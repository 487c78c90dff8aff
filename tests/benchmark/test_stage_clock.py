"""The clocks of a loop's stages charge each moment to one of them, and change nothing in what they watch."""

from __future__ import annotations

from itertools import pairwise

import pytest

from q2r2_control.benchmark import stage_clock
from q2r2_control.benchmark.stage_clock import REST, STAGES, StageClock


class Time:
    """Stands for the module ``time``: time passes where a test says so."""

    def __init__(self) -> None:
        self.now = 50.0

    def perf_counter(self) -> float:
        return self.now

    def sleep(self, duration: float) -> None:
        self.now += duration


class Loop:
    """A loop whose parts take known times [s]."""

    def __init__(self, time: Time) -> None:
        self._time = time

    def tick(self) -> None:
        self._time.now += 1.0
        self.teleop()
        self._time.now += 2.0
        self.supervision()

    def teleop(self) -> None:
        self._time.now += 4.0

    def supervision(self) -> None:
        self._time.now += 8.0
        self.control()
        self._time.now += 16.0

    def control(self) -> None:
        self._time.now += 32.0


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(stage_clock, "time", time)
    return time


def watched(clock: StageClock, loop: Loop) -> None:
    clock.watch_ticks(loop, "tick")
    for name in ("teleop", "supervision", "control"):
        clock.watch(loop, name, name)


def test_every_moment_counts_once_for_the_innermost_stage(time: Time) -> None:
    clock, loop = StageClock(), Loop(time)
    watched(clock, loop)
    time.now += 1000.0  # what comes before the first tick
    for _ in range(3):
        loop.tick()
        time.now += 64.0
    expected = {"teleop": 4.0, "supervision": 24.0, "control": 32.0, REST: 67.0}
    assert clock.times.shape == (2, len(STAGES)), "the end of the last tick is not known"
    for row in clock.times:
        assert dict(zip(STAGES, row, strict=True)) == {stage: expected.get(stage, 0.0) for stage in STAGES}


def test_waiting_for_the_next_tick_counts_for_no_stage(time: Time) -> None:
    clock, loop = StageClock(period=200.0), Loop(time)
    watched(clock, loop)
    begins = []
    for _ in range(4):
        loop.tick()
        begins.append(time.now - 63.0)
    assert [b - a for a, b in pairwise(begins)] == [200.0] * 3
    assert clock.times.sum(axis=1).tolist() == [63.0] * 3


class FailingLoop(Loop):
    def control(self) -> None:
        self._time.now += 5.0
        raise ValueError


def test_a_stage_that_raises_ends_all_the_same(time: Time) -> None:
    clock, loop = StageClock(), FailingLoop(time)
    watched(clock, loop)
    for _ in range(3):
        with pytest.raises(ValueError, match=r"^$"):
            loop.tick()
        time.now += 7.0
    for row in clock.times:
        stages = dict(zip(STAGES, row, strict=True))
        assert [stages[name] for name in ("teleop", "supervision", "control", REST)] == [4.0, 8.0, 5.0, 10.0]


def test_what_was_watched_is_left_as_it_was(time: Time) -> None:
    clock, loop = StageClock(), Loop(time)
    before = dict(vars(loop))
    watched(clock, loop)
    clock.release()
    assert vars(loop) == before
