"""The bench of the nodes, as a user runs it."""

from __future__ import annotations

import json
import sys

import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import PATIENCE, Processes, skip_if_overloaded

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone, pytest.mark.slow]


def test_the_bench_measures_both_ways_in_and_presses_and_the_load_of_real_nodes(processes: Processes) -> None:
    command = ("-m", "q2r2_control", "bench", "--ros", "--duration", "2", "--json")
    process = processes.start(sys.executable, *command, name="bench")
    assert process.wait(6.0 * PATIENCE) == 0
    report = json.loads(process.output)
    assert [row["path"] for row in report["rows"]] == ["target to joint command", "hand to joint command"]
    for row in report["rows"]:
        assert row["steps"] >= 10
        if row["missed"] > row["steps"] / 2:
            skip_if_overloaded(f"{row['missed']} of {row['steps']} steps were not answered in time")
        assert row["missed"] <= row["steps"] / 2
        assert 0.0 < report["transport_p50_ms"] < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
    presses = report["presses"]
    assert presses["starts"] == 1
    assert presses["period_ms"] > 0.0
    assert [(row["press"], row["count"]) for row in presses["rows"]] == [("first", 1), ("later", 4)]
    for row in presses["rows"]:
        if row["unanswered"] == row["count"]:
            skip_if_overloaded(f"no {row['press']} press was answered in time")
        assert row["unanswered"] < row["count"]
        assert 0.0 < row["tick_p50_ms"] <= row["tick_max_ms"]
        # A motion is the answer to a target, and what a button waits for the other one is in both.
        assert 80.0 <= row["target_p50_ms"] < row["motion_p50_ms"] <= row["motion_max_ms"]
    load = report["load"]
    nodes = [row["node"] for row in load["rows"]]
    assert nodes == ["mujoco_robot", "cartesian_controller", "arm_controllers", "SimulationInput"]
    assert all(row["moving"] > 0.0 for row in load["rows"])
    assert load["total"]["moving"] == pytest.approx(sum(row["moving"] for row in load["rows"]))
    assert load["commands_hz"] > 10.0
    assert load["speed_ripple"] > 0.0
