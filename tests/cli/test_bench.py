"""Tables of the bench and the soak: figures with units, every peer, and each broken promise with its tick."""

from __future__ import annotations

import io

import numpy as np
from rich.console import Console

from q2r2_control.benchmark.tick_times import BenchReport, BenchRow
from q2r2_control.benchmark.timed_run import RunMetrics
from q2r2_control.cli.bench import motion_table, soak_table, times_table
from q2r2_control.verification.contract import Margin
from q2r2_control.verification.soak import SoakReport, Violation


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


def test_a_broken_promise_is_in_the_table_with_its_tick_and_its_segment() -> None:
    margin = Margin("least distance", "m", ">=", 0.0)
    margin.note(0.1, 1)
    margin.note(-0.25, 7)
    q = np.zeros(14)
    found = Violation("least distance", 7, "teleport, dt 1 ms", 3, q, q, {}, "0.001", "")
    text = printed(soak_table(SoakReport("cell", 5, 9, 0.1, 1, 1, 0, 0, 0, [margin], 0.5, [found])))
    assert "seed 5" in text
    assert "-0.25 m" in text
    assert "first broken at tick 7: least distance" in " ".join(text.split())
    assert "teleport, dt 1 ms" in " ".join(text.split())
    assert "q2r2 bench --soak --seed 5 --ticks 8" in " ".join(text.split())
