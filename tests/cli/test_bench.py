"""Tables of the bench and the soak: figures with units, every peer, and each broken promise with its tick."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from q2r2_control.benchmark.loop_times import CASES, LoopReport, LoopRow, Ratio, RecordingCost, StageTime
from q2r2_control.benchmark.motion_run import MotionFigures
from q2r2_control.benchmark.press_times import PressReport, PressRow
from q2r2_control.benchmark.stack_bench import StackReport, StackRow
from q2r2_control.benchmark.stack_run import StackFigures
from q2r2_control.benchmark.stage_clock import PHYSICS, STAGES
from q2r2_control.benchmark.tick_times import BenchReport, BenchRow
from q2r2_control.benchmark.timed_run import RunMetrics
from q2r2_control.benchmark.work_bench import WorkReport, WorkRow
from q2r2_control.cli.loop_table import loop_table
from q2r2_control.cli.ros_table import presses_table
from q2r2_control.cli.soak_table import soak_table
from q2r2_control.cli.stack_table import following_table, safety_table
from q2r2_control.cli.times_table import motion_table, times_table
from q2r2_control.cli.work_table import work_table
from q2r2_control.config.cell import Config
from q2r2_control.types import CommandMode
from q2r2_control.verification.promises import Margin
from q2r2_control.verification.soak import SoakReport, Violation
from q2r2_control.verification.work_motions import motions_named
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


def through_the_stack(**changes: object) -> StackFigures:
    figures = StackFigures(
        motion="carry-0.20-0.30",
        mode="position",
        done=1.0,
        rms_error_mm=123.4,
        max_error_mm=234.5,
        path_error_mm=12.34,
        arrival_s=1.75,
        fallback_percent=12.34,
        measured_distance_mm=-48.3,
        measured_margin_mm=-68.3,
        reference_distance_mm=20.01,
        max_acceleration_ratio=1.0,
        max_torque_ratio=0.63,
        rest_acceleration=2.34,
        end_error_mm=5.67,
        slip_mm=231.1,
    )
    return replace(figures, **changes)  # type: ignore[arg-type]


def stack_report(*figures: StackFigures) -> StackReport:
    free = [through_the_stack(rms_error_mm=8.95, path_error_mm=1.34) for _ in figures]
    return StackReport("cell", 301, 1000.0, 0, [StackRow("carry-0.20-0.30", "round", False, list(figures), free)])


def test_eighty_columns_hold_every_heading_and_figure_of_motions_through_the_stack() -> None:
    report = stack_report(through_the_stack(), through_the_stack(mode="velocity", arrival_s=None))
    following, safety = printed(following_table(report)), printed(safety_table(report))
    for word in ("RMS", "free", "max", "path", "end", "there", "slip", "[mm]", "[s]", "carry-0.20-0.30: round"):
        assert word in following
    for word in ("held", "[%]", "near", "ref", "spare", "tau", "/limit", "rest", "[s-2]", "301 pairs"):
        assert word in safety
    position, velocity = following.splitlines()[6:8]
    assert position.split() == ["position", "123", "8.95", "234", "12.3", "1.34", "5.67", "1.75", "231"]
    assert velocity.split()[7] == "no"
    figures = ["12.3", "-48.3", "20.0", "-68.3", "1.00", "0.63", "2.34"]
    assert safety.splitlines()[6].split() == ["position", *figures]
    assert "2 runs: broken 0 times" in " ".join(safety.split())
    for table in (following, safety):
        assert "carry-0.20-0.30 (!)" in table
        assert "…" not in table
    assert report.passed


def test_what_went_wrong_in_the_stack_stands_below_the_table() -> None:
    broken = through_the_stack(broken={"acceleration / limit": 3}, pauses=["left: linked to right: no pose"])
    stopped = StackFigures("carry-0.20-0.30", "torque", 0.58, stopped="left_A2 is 0.160 rad from its reference")
    report = stack_report(broken, stopped)
    text = printed(safety_table(report))
    assert set(text.splitlines()[7].split()[1:]) == {"-"}
    for fault in (
        "carry-0.20-0.30, position: paused: left: linked to right: no pose",
        "carry-0.20-0.30, position: broken 3 times: acceleration / limit",
        "carry-0.20-0.30, torque: stopped at 58 %: left_A2 is 0.160 rad from its reference",
        "2 runs: broken 3 times",
    ):
        assert fault in " ".join(text.split())
    assert printed(following_table(report)).splitlines()[7].split()[6:8] == ["-", "no"]
    assert not report.passed


@pytest.mark.parametrize(("broken", "code"), [({}, 0), ({"acceleration / limit": 1}, 1)])
def test_through_the_stack_every_mode_runs_once_and_a_broken_promise_is_exit_code_1(
    broken: dict[str, int], code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def ran(
        config: Config, motions: object, modes: tuple[CommandMode, ...], seed: int, progress: object
    ) -> StackReport:
        asked.append((motions, modes, seed))
        return stack_report(through_the_stack(broken=broken))

    monkeypatch.setattr("q2r2_control.cli.bench.run_stack_bench", ran)
    options = ["--through", "torque", "--through", "position", "--through", "torque", "--motion", "meet", "--seed", "3"]
    result = q2r2("bench", "--work", *options, "--json")
    assert result.exit_code == code
    assert one_object(result.stdout)["passed"] is (code == 0)
    assert asked == [(motions_named(["meet"]), (CommandMode.TORQUE, CommandMode.POSITION), 3)]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--through", "torque"], "--through needs --work"),
        (["--contact"], "--contact needs --soak"),
        (["--work", "--seed", "3"], "--seed needs --soak, --rest or --through, since nothing else draws"),
    ],
)
def test_options_of_the_stack_that_make_no_sense_are_one_line(options: list[str], line: str) -> None:
    refused = q2r2("bench", *options)
    assert (refused.exit_code, refused.stderr) == (2, f"q2r2: {line}\n")


def test_a_broken_promise_is_in_the_table_with_its_tick_and_its_segment() -> None:
    margin = Margin("least distance", "m", ">=", 0.0)
    margin.note(0.1, 1)
    margin.note(-0.25, 7)
    q = np.zeros(14)
    found = Violation("least distance", 7, "teleport, dt 1 ms", 3, q, q, {}, "0.001", "")
    text = printed(soak_table(SoakReport("cell", 5, 9, 0.1, 1, 1, 0, 0, 0, 0, 0, 0, 0, [margin], 0.5, [found])))
    assert "seed 5" in text
    assert "-0.25 m" in text
    assert "first broken at tick 7: least distance" in " ".join(text.split())
    assert "teleport, dt 1 ms" in " ".join(text.split())
    assert "q2r2 bench --soak --seed 5 --ticks 8" in " ".join(text.split())


def test_eighty_columns_hold_every_stage_of_the_loop_for_each_plant_and_mode() -> None:
    stages = [StageTime(stage, 100.0 + index, 12340.0 + index) for index, stage in enumerate(STAGES)]
    whole, command = StageTime("without physics", 237.0, 54321.0), StageTime("to the command", 198.0, 43210.0)
    warm = StageTime("back to back", 152.0, 32101.0)
    rows = [LoopRow(plant, str(mode), 3000, 3, stages, whole, command, warm, 6.4) for plant, mode in CASES]
    text = printed(loop_table(LoopReport("cell", 1000.0, rows)))
    in_one_line = " ".join(text.split())
    for word in (*STAGES, "kinematic", "mujoco", "position", "torque", "p99", "[us]", "1000 Hz", "6, 6, 6 us"):
        assert word in in_one_line
    lines = text.splitlines()
    (total,) = (index for index, line in enumerate(lines) if "237" in line)
    assert lines[total].split() == ["without", "physics", *["237", "54321"] * 3]
    assert lines[total + 1].split() == ["to", "the", "command", *["198", "43210"] * 3]
    assert lines[total + 2].split() == ["back", "to", "back", *["152", "32101"] * 3]
    assert lines[total + 3].split()[0] == PHYSICS, "below the sum, which it is not in"
    assert "…" not in text


def test_the_first_press_and_later_ones_stand_side_by_side_and_what_was_not_measured_is_left_out() -> None:
    first = PressRow("first", 3, 3, None, None, None, None, None, None)
    later = PressRow("later", 12, 1, 10.04, 19.2, 87.5, 91.1, 112.3, 122.3)
    lines = [line.split() for line in printed(presses_table(PressReport(3, 5.02, (first, later)))).splitlines()]
    assert ["first", "first", "later", "later"] in lines
    assert ["longest", "tick", "10.0", "19.2"] in lines
    assert ["until", "the", "first", "target", "87.5", "91.1"] in lines
    assert ["until", "it", "moves", "112.3", "122.3"] in lines
    assert ["presses:", "3", "first,", "12", "later;", "not", "answered:", "4"] in lines


def test_the_cost_of_recording_is_a_ratio_with_its_interval_for_each_plant_and_mode() -> None:
    stages = [StageTime(stage, 100.0, 200.0) for stage in STAGES]
    whole, recorded = StageTime("without physics", 237.0, 500.0), StageTime("recorded", 251.0, 525.0)
    cost = RecordingCost(recorded, recorded, Ratio(1.05, 0.98, 1.12), Ratio(1.01, 0.957, 1.083))
    rows = [LoopRow(plant, str(mode), 3000, 10, stages, whole, whole, whole, 6.4, cost) for plant, mode in CASES]
    lines = printed(loop_table(LoopReport("cell", 1000.0, rows))).splitlines()
    assert [line.split() for line in lines if "recorded" in line] == [
        ["the", "same,", "recorded", *["251", "525"] * 3],
        ["to", "it,", "recorded", *["251", "525"] * 3],
    ]
    for plant, mode in CASES:
        line = f"  {plant}, {mode}: 1.05 (0.98-1.12); 1.01 (0.96-1.08)"
        assert line in [found.rstrip() for found in lines]


def test_the_loop_s_bench_prints_its_figures_as_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def made_up(config: Config, ticks: int, progress: object, *, record: bool) -> LoopReport:
        asked.append((ticks, record))
        stages = [StageTime(stage, 1.0, 2.0) for stage in STAGES]
        whole = StageTime("without physics", 9.0, 12.0)
        rows = [LoopRow(plant, str(mode), ticks, 3, stages, whole, whole, whole, 0.1) for plant, mode in CASES]
        return LoopReport("cell", 1e3, rows)

    monkeypatch.setattr("q2r2_control.cli.bench.run_loop_bench", made_up)
    found = one_object(q2r2("bench", "--loop", "--record", "--ticks", "200", "--json").stdout)
    assert asked == [(200, True)]
    assert {stage["stage"] for stage in found["rows"][2]["stages"]} == set(STAGES)
    assert found["rows"][2]["without_physics"]["median_us"] == 9.0


def test_the_loop_s_bench_has_a_camera_where_one_is_asked_for_and_it_is_recorded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Config] = []

    def made_up(config: Config, *_: object, **__: object) -> LoopReport:
        asked.append(config)
        return LoopReport("cell", 1e3, [])

    monkeypatch.setattr("q2r2_control.cli.bench.run_loop_bench", made_up)
    q2r2("bench", "--loop", "--record", "--camera", "--json")
    assert list(asked[0].simulated_cameras) == ["front"]
    refused = q2r2("bench", "--loop", "--camera")
    assert (refused.exit_code, refused.stderr) == (2, "q2r2: --camera needs --record\n")


@pytest.mark.parametrize("other", ["--soak", "--ros"])
def test_one_bench_at_a_time(other: str) -> None:
    refused = q2r2("bench", "--loop", other)
    line = "q2r2: --work, --soak, --rest, --ros, --loop, --press and --feel exclude each other\n"
    assert (refused.exit_code, refused.stderr) == (2, line)
