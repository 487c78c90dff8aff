"""How fast are KUKA's cabinets answered, and how well do the arms follow through them?"""

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
from q2r2_control.config.cell import load_config
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
_LONGEST_DELAY = 0.1  # that is looked for [s]
_FIRST = 90  # a priority above all others
# A thread that sleeps so long and wakes up later by more was kept waiting [s]. It sleeps when a halt begins: this finds
# each halt of their sum, 1 ms, half of the shortest period that is measured.
_SLEEP, _STILL = 0.0005, 0.0005
_WAIT = 60.0  # for the cabinets, on a busy computer [s]
_end: Any = None  # of a watching process: when its watch ends, by the monotonic clock [s]


def watch_until(end: Any) -> None:
    """In a process that is going to watch: until the shared ``end.value`` [s]."""
    global _end
    _end = end


def stand_stills(processor: int) -> list[tuple[float, float]]:
    """From when to when a processor kept even its first thread waiting, which only sleeps, until the watch ends [s]."""
    os.sched_setaffinity(0, {processor})
    found = []
    with real_time(_FIRST):
        while (before := time.monotonic()) < _end.value:
            time.sleep(_SLEEP)
            if (now := time.monotonic()) - before > _SLEEP + _STILL:
                found.append((before + _SLEEP, now))
    return found


def held_up(late: list[tuple[float, float]], stills: list[tuple[float, float]]) -> int:
    """How many answers waited for a processor that stood still, or for an answer before them that did.

    Both from when to when [s].
    """
    count, until = 0, -math.inf
    for begin, end in sorted(late):
        if begin < until or any(start < end and stop > begin for start, stop in stills):
            count, until = count + 1, max(until, end)
    return count


def undisturbed(answers: list[tuple[float, float]], stills: list[tuple[float, float]]) -> list[float]:
    """Durations [s] of the answers during which no processor stood still; both lists have begin and end [s]."""
    return [end - begin for begin, end in answers if not any(start < end and stop > begin for start, stop in stills)]


class ToolWay:
    """Where a reference led the tools, and where they were measured, of the ticks in which all were engaged."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        # Plain numbers: the garbage collector would go through a list of arrays, for more than 100 ms in mid-run. Where
        # postures lead the tools is calculated after the run, of which it would be a twentieth.
        self._postures, self._tools = array("d"), array("d")

    def __call__(self, tick: Tick) -> None:
        if all(tick.engaged.values()):
            self._postures.extend(tick.reference.q)
            for arm in self._robot.arms:
                self._tools.extend(tick.tools[arm].translation)

    def errors(self, delays: range) -> list[float]:
        """Of tools that are so many ticks behind, in the ticks in which a measurement was new [mm RMS]."""
        postures = np.array(self._postures).reshape(-1, self._robot.model.nv)
        led = np.array([[self._robot.tool_pose(q, arm).translation for arm in self._robot.arms] for q in postures])
        led, measured = (np.array(places).reshape(-1, len(self._robot.arms), 3) for places in (led, self._tools))
        is_new = (np.diff(measured, axis=0, prepend=np.inf) != 0.0).any(axis=2)
        squares = (
            np.square(measured[delay:] - led[: len(led) - delay]).sum(axis=2)[is_new[delay:]].mean() for delay in delays
        )
        return [float(1e3 * np.sqrt(square)) for square in squares]


def measure_directly(mode: CommandMode, duration: float) -> tuple[float, dict[str, float | None]]:
    """Errors without cabinets, in simulated time [mm RMS]: of the tools behind the reference, and behind the hands."""
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    pipeline = Pipeline(config, robot, ScriptedInput("circle"), MujocoPlant(robot, config), mode)
    pipeline.listeners.append(way := ToolWay(robot))
    summary = pipeline.run(duration, realtime=False)
    return way.errors(range(1))[0], {arm: figures.position_error_mm_rms for arm, figures in summary.arms.items()}


def measure(mode: CommandMode, duration: float, rt: bool, options: list[str]) -> dict[str, Any]:
    """Both hands go round circles for ``duration`` [s]; ``options`` of q2r2 fri-cabinet."""
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
    cabinets.stderr.readline()  # that they have begun
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    plant = FriPlant.from_config(robot, config)
    plant.answers = deque()  # all of them
    plant.longest_wait = plant.longest_session_wait = _WAIT
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
    errors = way.errors(range(round(_LONGEST_DELAY * config.nominal_rate_hz)))
    direct_error, direct_errors = measure_directly(mode, min(duration, 30.0))  # the circles repeat
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
    options: Annotated[list[str] | None, typer.Argument(help="Of q2r2 fri-cabinet, after --.")] = None,
    mode: Annotated[CommandMode, typer.Option(help="position or torque.")] = CommandMode.POSITION,
    duration: Annotated[float, typer.Option(min=1, help="[s]")] = 60.0,
    rt: Annotated[bool, typer.Option("--rt", help="Under SCHED_FIFO, as far as permitted.")] = False,
    json: Json = False,
) -> None:
    """Print how long cabinets wait for their answers, what they missed, and the error of the arms."""
    data = measure(mode, duration, rt, options or [])
    keys = "engaged_s", "error_mm_rms", "direct_errors_mm_rms"
    # The last end of a session is that of this run.
    rows = [
        (arm, *(data[key][arm] for key in keys), its["missed"], ", ".join(its["trips"][:-1]) or "-")
        for arm, its in data["cabinets"].items()
    ]
    errors = "RMS error [mm]", "without cabinets [mm]"
    columns = ("arm", "engaged [s]", *errors, "missed [answers]", "session ends before the run's")
    times, calm = data["answer_ms"], data["undisturbed_answer_ms"]
    notes = [
        f"answers after {times['p50']:.2f} ms in the median, {times['p99']:.2f} ms at 99 %",
        f"of the {data['undisturbed_answers']} of {data['answers']} answers during which this machine kept no processor"
        f" waiting: {calm['p50']:.2f} ms in the median, {calm['p99']:.2f} ms at 99 %",
        f"{data['late_answers']} answers after more than a period, {data['late_answers_in_stand_stills']} of them since"
        " this machine kept a processor waiting",
        f"it did so for {max(data['stand_stills_ms'], default=0.0):.1f} ms at most",
        f"the tools are {data['delay_ms']:.0f} ms behind the reference, and apart from that"
        f" {data['error_after_delay_mm_rms']:.2f} mm from it; without cabinets {data['direct_error_mm_rms']:.2f} mm",
        *(machine_notes() if rt else ()),
    ]
    print_report(data, (figure_table("two cabinets", columns, rows, notes),), json)


if __name__ == "__main__":
    typer.run(main)
