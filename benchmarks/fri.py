"""How fast are KUKA's cabinets answered, and how well do the arms follow through them?"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from array import array
from contextlib import ExitStack
from typing import Annotated, Any

import numpy as np
import typer

from q2r2_control.cli.output import Json, notice_of_compiling, print_report
from q2r2_control.config.cell import load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.scheduling import real_time
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import CommandMode
from q2r2_control.viewer.tables import figure_table

_CONFIG = "config/dual_iiwa7_fri.yaml"
_LONGEST_DELAY = 0.1  # that is looked for [s]


class ToolWay:
    """Where a reference led the tools, and where they were measured, of the ticks in which all were engaged."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        # Plain numbers: the garbage collector would go through a list of arrays, for more than 100 ms in mid-run.
        self._ticks = array("d")

    def __call__(self, tick: Tick) -> None:
        if all(tick.engaged.values()):
            for arm in tick.tools:
                self._ticks.extend(self._robot.tool_pose(tick.reference.q, arm).translation)
            for pose in tick.tools.values():
                self._ticks.extend(pose.translation)

    def error(self, delay: int) -> float:
        """Of tools that are ``delay`` ticks behind, in the ticks in which a measurement was new [mm RMS]."""
        led, measured = np.array(self._ticks).reshape(-1, 2, len(self._robot.arms), 3).swapaxes(0, 1)
        is_new = (np.diff(measured, axis=0, prepend=np.inf) != 0.0).any(axis=2)[delay:]
        apart = measured[delay:] - led[: len(led) - delay]
        return float(1e3 * np.sqrt(np.square(apart[is_new]).sum(axis=1).mean()))


def measure_directly(mode: CommandMode, duration: float) -> float:
    """The error without cabinets, in simulated time [mm RMS]."""
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    pipeline = Pipeline(config, robot, ScriptedInput("circle"), MujocoPlant(robot, config), mode)
    pipeline.listeners.append(way := ToolWay(robot))
    pipeline.run(duration, realtime=False)
    return way.error(0)


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
    cabinets = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert cabinets.stderr is not None
    cabinets.stderr.readline()  # that they have begun
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    plant = FriPlant.from_config(robot, config)
    with notice_of_compiling():
        pipeline = Pipeline(config, robot, ScriptedInput("circle"), plant, mode)
    pipeline.listeners.append(way := ToolWay(robot))
    try:
        with ExitStack() as stack:
            if rt:
                stack.enter_context(real_time())
            summary = pipeline.run(duration)
    finally:
        cabinets.send_signal(signal.SIGINT)
        said, _ = cabinets.communicate()
    errors = [way.error(delay) for delay in range(round(_LONGEST_DELAY * config.loop_rate_hz))]
    return {
        "delay_ms": 1e3 * int(np.argmin(errors)) / config.loop_rate_hz,
        "error_after_delay_mm_rms": min(errors),
        "direct_error_mm_rms": measure_directly(mode, min(duration, 30.0)),  # the circles repeat
        "answers": len(plant.answer_times),
        "answer_ms": dict(
            zip(("p50", "p99", "max"), 1e3 * np.percentile(plant.answer_times, (50, 99, 100)), strict=True)
        ),
        "lost_messages": {arm: state.lost for arm, state in plant.states().items()},
        "engaged_s": {arm: figures.engaged_s for arm, figures in summary.arms.items()},
        "error_mm_rms": {arm: figures.position_error_mm_rms for arm, figures in summary.arms.items()},
        "cabinets": json.loads(said)["cabinets"],
    }


def main(
    options: Annotated[list[str] | None, typer.Argument(help="Of q2r2 fri-cabinet, after --.")] = None,
    mode: Annotated[CommandMode, typer.Option(help="position or torque.")] = CommandMode.POSITION,
    duration: Annotated[float, typer.Option(min=1, help="[s]")] = 60.0,
    rt: Annotated[bool, typer.Option("--rt", help="Under SCHED_FIFO, as far as permitted.")] = False,
    json: Json = False,
) -> None:
    """Print how long cabinets wait for their answers, what they missed, and the error of the arms."""
    data = measure(mode, duration, rt, options or [])
    # The last end of a session is that of this run.
    rows = [
        (arm, data["engaged_s"][arm], data["error_mm_rms"][arm], its["missed"], ", ".join(its["trips"][:-1]) or "-")
        for arm, its in data["cabinets"].items()
    ]
    columns = ("arm", "engaged [s]", "RMS error [mm]", "missed [answers]", "session ends before the run's")
    times = data["answer_ms"]
    notes = [
        f"answers after {times['p50']:.2f} ms in the median, {times['p99']:.2f} ms at 99 %",
        f"the tools are {data['delay_ms']:.0f} ms behind the reference, and apart from that"
        f" {data['error_after_delay_mm_rms']:.2f} mm from it; without cabinets {data['direct_error_mm_rms']:.2f} mm",
    ]
    print_report(data, (figure_table("two cabinets", columns, rows, notes),), json)


if __name__ == "__main__":
    typer.run(main)
