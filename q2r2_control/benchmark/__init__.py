"""Figures of this machine: control ticks beside public peers, work motions, a whole loop, latencies through ROS nodes.

``tick_times`` times our controller and the ``peers`` in turns, by runs of ``timed_run``. ``work_bench`` asks them for
two-armed work, one motion and one controller at a time by ``motion_run``, which tests can use alone. ``stack_bench``
runs the same motions from hand samples to arms in MuJoCo, by ``stack_run``. ``loop_times`` tells where a tick of the
live loop goes, by ``stage_clock``, and ``feel_run`` what an operator feels of a filter. ``command_responses`` finds the
commands that answer steps of an input, ``press_times`` what follows a press; ``ros_latency`` and ``ros_press``, which
need ROS, record them. ``press_run`` presses a finger on the table, and ``sliding_stability`` tells from which
friction on such a slide chatters by itself. ``rest_run`` asks for places that the arms get in each other's way at.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.benchmark.command_responses import LatencyReport, LatencyRow, latency_report
    from q2r2_control.benchmark.loop_times import LoopReport, LoopRow, run_loop_bench
    from q2r2_control.benchmark.motion_run import MotionFigures, own_controller, run_motion, without_pairs
    from q2r2_control.benchmark.stack_bench import StackReport, StackRow, run_stack_bench
    from q2r2_control.benchmark.stack_run import Stack, StackFigures
    from q2r2_control.benchmark.tick_times import BenchReport, BenchRow, run_bench
    from q2r2_control.benchmark.timed_run import RunMetrics, TimedRun
    from q2r2_control.benchmark.work_bench import WorkReport, WorkRow, run_work_bench

__all__ = [
    "BenchReport",
    "BenchRow",
    "LatencyReport",
    "LatencyRow",
    "LoopReport",
    "LoopRow",
    "MotionFigures",
    "RunMetrics",
    "Stack",
    "StackFigures",
    "StackReport",
    "StackRow",
    "TimedRun",
    "WorkReport",
    "WorkRow",
    "latency_report",
    "own_controller",
    "run_bench",
    "run_loop_bench",
    "run_motion",
    "run_stack_bench",
    "run_work_bench",
    "without_pairs",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "BenchReport": "tick_times",
        "BenchRow": "tick_times",
        "LatencyReport": "command_responses",
        "LatencyRow": "command_responses",
        "MotionFigures": "motion_run",
        "LoopReport": "loop_times",
        "LoopRow": "loop_times",
        "RunMetrics": "timed_run",
        "Stack": "stack_run",
        "StackFigures": "stack_run",
        "StackReport": "stack_bench",
        "StackRow": "stack_bench",
        "TimedRun": "timed_run",
        "WorkReport": "work_bench",
        "WorkRow": "work_bench",
        "latency_report": "command_responses",
        "own_controller": "motion_run",
        "run_bench": "tick_times",
        "run_motion": "motion_run",
        "run_stack_bench": "stack_bench",
        "run_work_bench": "work_bench",
        "without_pairs": "motion_run",
        "run_loop_bench": "loop_times",
    },
)
