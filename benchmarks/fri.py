"""How fast do KUKA's cabinets get their answers, and how well do the arms behind the cabinets follow?"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from array import array
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from typing import Annotated, Any

import numpy as np
import typer

from q2r2_control.cli.output import Json, notice_of_compiling, print_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.machine_notes import machine_notes
from q2r2_control.process.scheduling import real_time
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import CommandMode
from q2r2_control.viewer.tables import figure_table

_CONFIG = "config/dual_iiwa7_fri.yaml"
_MAX_DELAY_S = 0.1  # The delay of the tools behind their reference is searched for up to this delay [s].
_WATCH_PRIORITY = 90  # Real-time priority of the watching threads, above all others.
# A watching thread sleeps for the first of these times. If it wakes up late by more than the second time, its processor
# stood still. The thread usually sleeps when a standstill begins, so each standstill of at least the sum of both times
# is found. The sum is 1 ms, half of the shortest period that is measured [s].
_WATCH_SLEEP_S, _MIN_LATENESS_S = 0.0005, 0.0005
_CABINET_TIMEOUT_S = 60.0  # Timeout for the cabinets on a busy computer [s].
_end: Any = None  # In a watching process: its ``value`` is the time at which the watch ends (monotonic clock) [s].


def watch_until(end: Any) -> None:
    """Initialize a watching process, whose watch ends at the shared time ``end.value`` [s]."""
    global _end
    _end = end


def stand_stills(processor: int) -> list[tuple[float, float]]:
    """Return start and end of each standstill of a processor until the watch ends [s].

    The thread that runs this function has the highest priority and only sleeps. If it wakes up late, its processor
    stood still.
    """
    os.sched_setaffinity(0, {processor})
    found = []
    with real_time(_WATCH_PRIORITY):
        while (before := time.monotonic()) < _end.value:
            time.sleep(_WATCH_SLEEP_S)
            if (now := time.monotonic()) - before > _WATCH_SLEEP_S + _MIN_LATENESS_S:
                found.append((before + _WATCH_SLEEP_S, now))
    return found


def held_up(late: list[tuple[float, float]], stills: list[tuple[float, float]]) -> int:
    """Return the number of late answers that a standstill has delayed, directly or by delaying an earlier answer.

    Both lists have pairs of a start and an end [s].
    """
    count, until = 0, -math.inf
    for begin, end in sorted(late):
        if begin < until or any(start < end and stop > begin for start, stop in stills):
            count, until = count + 1, max(until, end)
    return count


def undisturbed(answers: list[tuple[float, float]], stills: list[tuple[float, float]]) -> list[float]:
    """Return the durations [s] of the answers during which no processor stood still.

    Both lists have pairs of a start and an end [s].
    """
    return [end - begin for begin, end in answers if not any(start < end and stop > begin for start, stop in stills)]


class ToolWay:
    """The commanded and measured positions of the tools in the ticks in which all arms were engaged."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        # Arrays of plain numbers are used here, because the garbage collector would search a list of arrays for more
        # than 100 ms during the run. The commanded positions of the tools are computed only after the run, because this
        # takes a twentieth of the run's time.
        self._postures, self._tools = array("d"), array("d")

    def __call__(self, tick: Tick) -> None:
        if all(tick.engaged.values()):
            self._postures.extend(tick.reference.q)
            for arm in self._robot.arms:
                self._tools.extend(tick.tools[arm].translation)

    def errors(self, delays: range) -> list[float]:
        """Return the error [mm RMS] for each assumed delay of the tools behind their reference, in ``delays`` [ticks].

        Only ticks with a new measurement count.
        """
        postures = np.array(self._postures).reshape(-1, self._robot.model.nv)
        led = np.array([[self._robot.tool_pose(q, arm).translation for arm in self._robot.arms] for q in postures])
        led, measured = (np.array(places).reshape(-1, len(self._robot.arms), 3) for places in (led, self._tools))
        is_new = (np.diff(measured, axis=0, prepend=np.inf) != 0.0).any(axis=2)
        squares = (
            np.square(measured[delay:] - led[: len(led) - delay]).sum(axis=2)[is_new[delay:]].mean() for delay in delays
        )
        return [float(1e3 * np.sqrt(square)) for square in squares]


def measure_directly(mode: CommandMode, duration: float) -> tuple[float, dict[str, float | None]]:
    """Run without cabinets in simulated time, and return two errors of the measured tools [mm RMS].

    The first error is the distance of all tools from the reference. The second error is the distance of each tool from
    its targets, by arm. It is None for an arm that was not engaged.
    """
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    pipeline = Pipeline(config, robot, ScriptedInput("circle"), MujocoPlant(robot, config), mode)
    pipeline.listeners.append(way := ToolWay(robot))
    summary = pipeline.run(duration, realtime=False)
    return way.errors(range(1))[0], {arm: figures.position_error_mm_rms for arm, figures in summary.arms.items()}


def measure(mode: CommandMode, duration: float, rt: bool, options: list[str]) -> dict[str, Any]:
    """Measure while both hands go round circles for ``duration`` [s]; ``options`` go to q2r2 fri-cabinet."""
    words = [
        sys.executable,
        "-m",
        "q2r2_control",
        "fri-cabinet",
        _CONFIG,
        "--json",
        "--mode",
        mode,
        *(["--rt"] if rt else ()),
        *options,
    ]
    processors = sorted(os.sched_getaffinity(0))
    context = get_context("spawn")
    end = context.RawValue("d", math.inf)
    watching = ProcessPoolExecutor(len(processors), context, watch_until, (end,))
    stills = [watching.submit(stand_stills, each) for each in processors if rt]
    cabinets = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert cabinets.stderr is not None
    cabinets.stderr.readline()  # This line says that the cabinets have started.
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    plant = FriPlant.from_config(robot, config)
    plant.answers = deque()  # Without a maximum length, all answers are kept.
    plant.longest_wait = plant.longest_session_wait = _CABINET_TIMEOUT_S
    with notice_of_compiling():
        pipeline = Pipeline(config, robot, ScriptedInput("circle"), plant, mode)
    pipeline.listeners.append(way := ToolWay(robot))
    try:
        with ExitStack() as stack:
            if rt:
                stack.enter_context(real_time())
            summary = pipeline.run(duration)
    finally:
        end.value = time.monotonic()
        cabinets.send_signal(signal.SIGINT)
        said, _ = cabinets.communicate()
    moments = [moment for each in stills for moment in each.result()]
    watching.shutdown()
    arrived, took = np.array(plant.answers).T
    period = max(state.period for state in plant.states().values())
    answers = [(came, came + its) for came, its in zip(arrived, took, strict=True)]
    late = [its for its in answers if its[1] - its[0] > period]
    calm = undisturbed(answers, moments)
    errors = way.errors(range(round(_MAX_DELAY_S * config.nominal_rate_hz)))
    # The circles repeat, so a short run without cabinets is enough.
    direct_error, direct_errors = measure_directly(mode, min(duration, 30.0))
    return {
        "delay_ms": 1e3 * int(np.argmin(errors)) / config.nominal_rate_hz,
        "error_after_delay_mm_rms": min(errors),
        "direct_error_mm_rms": direct_error,
        "answers": len(took),
        "answer_ms": _percentiles_ms(took),
        "undisturbed_answers": len(calm),
        "undisturbed_answer_ms": _percentiles_ms(calm),
        "late_answers": len(late),
        "late_answers_in_stand_stills": held_up(late, moments),
        "stand_stills_ms": sorted((round(1e3 * (b - a), 1) for a, b in moments), reverse=True),
        "lost_messages": {arm: state.lost for arm, state in plant.states().items()},
        "engaged_s": {arm: figures.engaged_s for arm, figures in summary.arms.items()},
        "error_mm_rms": {arm: figures.position_error_mm_rms for arm, figures in summary.arms.items()},
        "direct_errors_mm_rms": direct_errors,
        "cabinets": json.loads(said)["cabinets"],
    }


def _percentiles_ms(times: Sequence[float]) -> dict[str, float]:
    return dict(zip(("p50", "p99", "max"), 1e3 * np.percentile(times, (50, 99, 100)), strict=True))


def main(
    options: Annotated[list[str] | None, typer.Argument(help="Options of q2r2 fri-cabinet, after --.")] = None,
    mode: Annotated[CommandMode, typer.Option(help="Command mode of the arms.")] = CommandMode.POSITION,
    duration: Annotated[float, typer.Option(min=1, help="Duration of the run [s].")] = 60.0,
    rt: Annotated[
        bool, typer.Option("--rt", help="Run with the real-time scheduling SCHED_FIFO where it is permitted.")
    ] = False,
    json: Json = False,
) -> None:
    """Print how long cabinets wait for their answers, how many answers they missed, and the error of the arms."""
    data = measure(mode, duration, rt, options or [])
    keys = "engaged_s", "error_mm_rms", "direct_errors_mm_rms"
    # A cabinet reports why each of its FRI sessions ended. The last session ended because this run ended, so its reason
    # is left out.
    rows = [
        (arm, *(data[key][arm] for key in keys), its["missed"], ", ".join(its["trips"][:-1]) or "-")
        for arm, its in data["cabinets"].items()
    ]
    errors = "RMS error [mm]", "without cabinets [mm]"
    columns = ("arm", "engaged [s]", *errors, "missed [answers]", "session ends before the run's")
    times, calm = data["answer_ms"], data["undisturbed_answer_ms"]
    notes = [
        f"An answer takes {times['p50']:.2f} ms in the median, and {times['p99']:.2f} ms at the 99th percentile.",
        f"During {data['undisturbed_answers']} of {data['answers']} answers no processor of this machine stood still."
        f" These take {calm['p50']:.2f} ms in the median, and {calm['p99']:.2f} ms at the 99th percentile.",
        f"{data['late_answers']} answers took more than a period, {data['late_answers_in_stand_stills']} of them"
        " because a processor of this machine stood still.",
        f"The longest standstill took {max(data['stand_stills_ms'], default=0.0):.1f} ms.",
        f"The tools are {data['delay_ms']:.0f} ms behind the reference. Apart from that delay their error is"
        f" {data['error_after_delay_mm_rms']:.2f} mm RMS. Without cabinets it is {data['direct_error_mm_rms']:.2f} mm.",
        *(machine_notes() if rt else ()),
    ]
    print_report(data, (figure_table("two cabinets", columns, rows, notes),), json)


if __name__ == "__main__":
    typer.run(main)
