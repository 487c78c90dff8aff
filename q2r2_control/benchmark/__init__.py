"""Figures of this machine: times of a control tick beside public peers, of a whole loop, latencies through ROS nodes.

``tick_times`` times our controller and the ``peers`` in turns, by runs of ``timed_run``. ``loop_times`` tells where a
tick of the live loop goes. ``command_responses`` finds the commands that answer steps of an input, and ``ros_latency``,
which needs ROS, records them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.benchmark.command_responses import LatencyReport, LatencyRow, latency_report
    from q2r2_control.benchmark.loop_times import LoopReport, LoopRow, run_loop_bench
    from q2r2_control.benchmark.tick_times import BenchReport, BenchRow, run_bench
    from q2r2_control.benchmark.timed_run import RunMetrics, TimedRun

__all__ = [
    "BenchReport",
    "BenchRow",
    "LatencyReport",
    "LatencyRow",
    "LoopReport",
    "LoopRow",
    "RunMetrics",
    "TimedRun",
    "latency_report",
    "run_bench",
    "run_loop_bench",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "BenchReport": "tick_times",
        "BenchRow": "tick_times",
        "LatencyReport": "command_responses",
        "LatencyRow": "command_responses",
        "LoopReport": "loop_times",
        "LoopRow": "loop_times",
        "RunMetrics": "timed_run",
        "TimedRun": "timed_run",
        "latency_report": "command_responses",
        "run_bench": "tick_times",
        "run_loop_bench": "loop_times",
    },
)
