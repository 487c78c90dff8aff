"""The bench of the loop charges each moment to one stage, of the product's own tick, and changes nothing in a run."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest

from q2r2_control.benchmark import loop_times
from q2r2_control.benchmark.loop_times import CASES, REST, STAGES, StageClock, run_loop_bench
from q2r2_control.config import load_config
from q2r2_control.config.cameras import CameraConfig
from q2r2_control.errors import ConfigError

CONFIG = load_config("config/dual_iiwa7.yaml")


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
    monkeypatch.setattr(loop_times, "time", time)
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


def test_it_times_the_loop_s_own_ticks_of_every_plant_and_mode() -> None:
    report = run_loop_bench(CONFIG, 100, paced=False, record=True)
    assert [(row.plant, row.mode) for row in report.rows] == [(plant, str(mode)) for plant, mode in CASES]
    for row in report.rows:
        assert tuple(stage.stage for stage in row.stages) == STAGES
        assert (row.ticks, row.rounds) == (100, 3)
        # Each stage is called at every tick.
        assert all(0.0 < stage.median_us <= stage.p99_us for stage in row.stages)
        assert 0.0 < row.to_command.median_us < row.without_physics.median_us <= row.without_physics.p99_us
        assert row.recorded is not None
        assert row.to_command_recorded is not None
        assert 0.0 < row.to_command_recorded.median_us < row.recorded.median_us
    json.dumps(report.as_json(), allow_nan=False)


def test_pictures_are_taken_where_mujoco_is() -> None:
    camera = CameraConfig(position=(1.9, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=64, height=48, rate=10.0)
    report = run_loop_bench(CONFIG.model_copy(update={"cameras": {"front": camera}}), 100, paced=False, record=True)
    assert all(row.recorded is not None for row in report.rows)


def test_too_few_ticks_are_refused() -> None:
    with pytest.raises(ConfigError, match="ticks = 99: allowed: 100 or more"):
        run_loop_bench(CONFIG, 99)
