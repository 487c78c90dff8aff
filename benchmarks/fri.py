"""How fast are KUKA's cabinets answered, and how well do the arms follow through them?"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from contextlib import ExitStack
from typing import Annotated, Any

import numpy as np
import typer

from q2r2_control.cli.output import Json, notice_of_compiling, print_report
from q2r2_control.config.cell import load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.process.scheduling import real_time
from q2r2_control.robot.robot import Robot
from q2r2_control.viewer.tables import figure_table

_CONFIG = "config/dual_iiwa7_fri.yaml"


def measure(duration: float, rt: bool, options: list[str]) -> dict[str, Any]:
    """Both hands go round circles for ``duration`` [s]; ``options`` of q2r2 fri-cabinet."""
    config = load_config(_CONFIG)
    robot = Robot.from_config(config)
    plant = FriPlant.from_config(robot, config)
    with notice_of_compiling():
        pipeline = Pipeline(config, robot, ScriptedInput("circle"), plant)
    words = [sys.executable, "-m", "q2r2_control", "fri-cabinet", _CONFIG, "--json", *options]
    cabinets = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        with ExitStack() as stack:
            if rt:
                stack.enter_context(real_time())
            summary = pipeline.run(duration)
    finally:
        cabinets.send_signal(signal.SIGINT)
        said, _ = cabinets.communicate()
    return {
        "answers": len(plant.answer_times),
        "answer_ms": dict(
            zip(("p50", "p99", "max"), 1e3 * np.percentile(plant.answer_times, (50, 99, 100)), strict=True)
        ),
        "lost_messages": {arm: session.lost for arm, session in plant.cell.sessions.items()},
        "engaged_s": {arm: figures.engaged_s for arm, figures in summary.arms.items()},
        "error_mm_rms": {arm: figures.position_error_mm_rms for arm, figures in summary.arms.items()},
        "cabinets": json.loads(said)["cabinets"],
    }


def main(
    options: Annotated[list[str] | None, typer.Argument(help="Of q2r2 fri-cabinet, after --.")] = None,
    duration: Annotated[float, typer.Option(min=1, help="[s]")] = 60.0,
    rt: Annotated[bool, typer.Option("--rt", help="Under SCHED_FIFO, as far as permitted.")] = False,
    json: Json = False,
) -> None:
    """Print how long cabinets wait for their answers, what they missed, and the error of the arms."""
    data = measure(duration, rt, options or [])
    rows = [
        (arm, data["engaged_s"][arm], data["error_mm_rms"][arm], its["missed"], ", ".join(its["trips"]) or "-")
        for arm, its in data["cabinets"].items()
    ]
    columns = ("arm", "engaged [s]", "RMS error [mm]", "missed [answers]", "session ends")
    times = data["answer_ms"]
    notes = [f"answers after {times['p50']:.2f} ms in the median, {times['p99']:.2f} ms at 99 %"]
    print_report(data, (figure_table("two cabinets", columns, rows, notes),), json)


if __name__ == "__main__":
    typer.run(main)
