"""The bench of the nodes, as a user runs it."""

from __future__ import annotations

import json
import sys

import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import PATIENCE, Processes, skip_if_overloaded

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]


def test_the_bench_measures_both_ways_in_through_real_nodes(processes: Processes) -> None:
    command = ("-m", "q2r2_control", "bench", "--ros", "--duration", "2", "--json")
    process = processes.start(sys.executable, *command, name="bench")
    assert process.wait(4.0 * PATIENCE) == 0
    report = json.loads(process.output)
    assert [row["path"] for row in report["rows"]] == ["target to joint command", "hand to joint command"]
    for row in report["rows"]:
        assert row["steps"] >= 10
        if row["missed"] > row["steps"] / 2:
            skip_if_overloaded(f"{row['missed']} of {row['steps']} steps were not answered in time")
        assert row["missed"] <= row["steps"] / 2
        assert 0.0 < report["transport_p50_ms"] < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
