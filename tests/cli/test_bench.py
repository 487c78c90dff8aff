"""Tables of the bench and the soak: figures with units, every peer, and each broken promise with its tick."""

from __future__ import annotations

import io

import numpy as np
import pytest
from rich.console import Console

from q2r2_control.benchmark.loop_times import CASES, PHYSICS, STAGES, LoopReport, LoopRow, StageTime, run_loop_bench
from q2r2_control.benchmark.motion_run import MotionFigures
from q2r2_control.benchmark.tick_times import BenchReport, BenchRow
from q2r2_control.benchmark.timed_run import RunMetrics
from q2r2_control.benchmark.work_bench import WorkReport, WorkRow
from q2r2_control.cli.bench import loop_table, motion_table, soak_table, times_table
from q2r2_control.cli.work_table import work_table
from q2r2_control.config import Config
from q2r2_control.verification.contract import Margin
from q2r2_control.verification.soak import SoakReport, Violation
from tests.cli.test_app import one_object, q2r2

TIMES = ("1234", "18765")


def printed(table: object, width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def report() -> BenchReport:
    metrics = RunMetrics(1.0, 0.5, 0.2, 22.01, 3, 0.015, 1.0)
    rows = [
        BenchRow("free motion", "q2r2_control", 3000, 12, 51.0, 99.0, 12345678.0, None, None, metrics, 0),
        BenchRow("free motion", "roboplan, 10 nearest", 3000, 3, 902.0, 5000.0, 12345678.0, 17.7, 9.25, metrics, None),
    ]
    return BenchReport("cell", 139, rows, ["roboplan: no certificate"])


def test_eighty_columns_hold_every_heading_and_figure_of_the_bench() -> None:
    text = printed(times_table(report())) + printed(motion_table(report()))
    for word in ("median", "[us]", "p99", "nearest", "[mm]", "room", "[rad]", "tail", "[rad/s^2]", "free motion"):
        assert word in text
    for figure in ("roboplan, 10 nearest", "12345678", "17.70", "9.25", "22.01", "0.015", "no certificate"):
        assert figure in text
    assert "…" not in text


def figures_of(controller: str, **figures: float | None) -> MotionFigures:
    known = {"rms_error_mm": 123.4, "max_error_mm": 234.5, "min_distance_mm": -48.3, "max_acceleration": 2034.2}
    timed = {"rest_acceleration": 0.023, "median_us": 1234.5, "p99_us": 18765.4}
    return MotionFigures("pass-back", controller, **{"done": 1.0, "ticks": 1000, **known, **timed, **figures})  # type: ignore[arg-type]


def test_eighty_columns_hold_every_heading_and_figure_of_the_work_motions() -> None:
    free = figures_of("free air", rms_error_mm=2.17, arrival_s=1.5)
    rows = [
        figures_of("q2r2_control", arrival_s=1.75, fallback_percent=12.34),
        figures_of("roboplan, 10 nearest", failures=5),
        figures_of("mink", done=0.58, rest_acceleration=None),
    ]
    report = WorkReport("cell", 167, [WorkRow("pass-back", "back again", False, free, rows)], ["mink: no certificate"])
    text = printed(work_table(report))
    for word in ("RMS", "[mm]", "there", "[s]", "held", "[%]", "near", "|a|", "[s-2]", "p99", "[us]"):
        assert word in text
    ours, roboplan, mink, gave_up = text.splitlines()[6:10]
    assert ours.split() == ["q2r2_control", "123", "234", "2.17", "1.75", "12.3", "-48.3", "2034", "0.02", *TIMES]
    assert roboplan.split()[3:] == ["123", "234", "no", "0.50", "-48.3", "2034", "0.02", *TIMES]
    # No acceleration limit, and not at rest, since it was not waited for.
    assert mink.split() == ["mink", "123", "234", "no", "0.00", "-48.3", "2034*", "-", *TIMES]
    assert gave_up.strip() == "gave up at 58 %"
    for words in ("pass-back (!)", "pass-back: back again", "mink: no certificate", "* has no acceleration limit"):
        assert words in text
    assert "…" not in text


def test_a_motion_without_a_goal_has_no_time_of_arrival_and_one_that_never_began_no_figures() -> None:
    nothing = MotionFigures("oscillate", "q2r2_control", done=0.01)
    row = WorkRow("oscillate", "", True, figures_of("free air"), [figures_of("q2r2_control"), nothing])
    ours, none = printed(work_table(WorkReport("cell", 1, [row], []))).splitlines()[6:8]
    assert ours.split()[1:6] == ["123", "234", "123", "-", "0.00"]
    assert set(none.split()[1:]) == {"-"}


def test_a_broken_promise_is_in_the_table_with_its_tick_and_its_segment() -> None:
    margin = Margin("least distance", "m", ">=", 0.0)
    margin.note(0.1, 1)
    margin.note(-0.25, 7)
    q = np.zeros(14)
    found = Violation("least distance", 7, "teleport, dt 1 ms", 3, q, q, {}, "0.001", "")
    text = printed(soak_table(SoakReport("cell", 5, 9, 0.1, 1, 1, 0, 0, 0, 0, 0, [margin], 0.5, [found])))
    assert "seed 5" in text
    assert "-0.25 m" in text
    assert "first broken at tick 7: least distance" in " ".join(text.split())
    assert "teleport, dt 1 ms" in " ".join(text.split())
    assert "q2r2 bench --soak --seed 5 --ticks 8" in " ".join(text.split())


def test_eighty_columns_hold_every_stage_of_the_loop_for_each_plant_and_mode() -> None:
    stages = [StageTime(stage, 100.0 + index, 12340.0 + index) for index, stage in enumerate(STAGES)]
    whole = StageTime("without physics", 237.0, 54321.0)
    rows = [LoopRow(plant, str(mode), 3000, 3, stages, whole, 6.4) for plant, mode in CASES]
    text = printed(loop_table(LoopReport("cell", 1000.0, rows)))
    in_one_line = " ".join(text.split())
    for word in (*STAGES, "kinematic", "mujoco", "position", "torque", "p99", "[us]", "1000 Hz", "6, 6, 6 us"):
        assert word in in_one_line
    lines = text.splitlines()
    (total,) = (index for index, line in enumerate(lines) if "237" in line)
    assert lines[total].split() == ["without", "physics", *["237", "54321"] * 3]
    assert lines[total + 1].split()[0] == PHYSICS, "below the sum, which it is not in"
    assert "…" not in text


def test_the_loop_s_bench_prints_its_figures_as_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def short(config: Config, ticks: int, progress: object) -> LoopReport:
        asked.append(ticks)
        return run_loop_bench(config, 100, paced=False)

    monkeypatch.setattr("q2r2_control.cli.bench.run_loop_bench", short)
    found = one_object(q2r2("bench", "--loop", "--ticks", "200", "--json").stdout)
    assert asked == [200]
    assert {stage["stage"] for stage in found["rows"][2]["stages"]} == set(STAGES)
    assert found["rows"][2]["without_physics"]["median_us"] > 0.0


@pytest.mark.parametrize("other", ["--soak", "--ros"])
def test_one_bench_at_a_time(other: str) -> None:
    refused = q2r2("bench", "--loop", other)
    assert (refused.exit_code, refused.stderr) == (2, "q2r2: --work, --soak, --ros and --loop exclude each other\n")
