"""``q2r2 check``: what a cell consists of, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from q2r2_control.cli.cell_report import ArmCheck, CellCheck, PairsWritten, check_cell, write_model_pairs, write_pairs
from q2r2_control.cli.figure_table import Cell, figure_table
from q2r2_control.cli.options import ConfigFile, Json
from q2r2_control.cli.output import as_json_text, notice_of_compiling, print_report, stderr_console
from q2r2_control.cli.progress_lines import ProgressLines
from q2r2_control.config.cell import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.stop_torque import StopTorque


def check(
    config: ConfigFile,
    pairs: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Find pairs that can never meet and write them as an SRDF for the key srdf."),
    ] = None,
    model_pairs: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Find such pairs of each arm and tool alone, and write ARM.srdf and so on."
        ),
    ] = None,
    samples: Annotated[int, typer.Option(help="Random postures that --pairs and --model-pairs look at.")] = 20_000,
    clearance: Annotated[float, typer.Option(help="Pairs that stay farther apart need no watching [m].")] = 0.05,
    json: Json = False,
) -> None:
    """Validate a cell and print its arms, limits, obstacles and distances at home; exit 1 where home is unsafe."""
    if pairs is not None and model_pairs is not None:
        raise ConfigError("--pairs and --model-pairs exclude each other")
    cell, progress = load_config(config), ProgressLines(stderr_console())
    if pairs is not None:
        found = write_pairs(cell, pairs, samples, clearance, progress=progress)
        print_report(asdict(found), (pair_reach_table(found),), json)
        return
    if model_pairs is not None:
        files = write_model_pairs(cell, model_pairs, samples, clearance, progress=progress)
        rows = ((file, "new" if new else "as it was") for file, new in files.items())
        title = "pairs of the models' links that need no watching"
        print_report(files, (figure_table(title, ("file", "is"), rows),), json)
        return
    result = check_cell(cell, notice_of_compiling(stderr_console()))
    if json:
        print(as_json_text(result.as_json()))
    else:
        _print_cell(result)
    raise typer.Exit(1 if result.faults else 0)


def _print_cell(result: CellCheck) -> None:
    console = Console()
    console.print(f"cell {result.name}", highlight=False)
    for table in cell_tables(result):
        console.print(table)
    for arm, line in (result.driven or {"arms": "the built-in controller"}).items():
        console.print(f"{arm} driven by {line}", highlight=False, markup=False, soft_wrap=True)
    for note in result.notes:
        console.print(f"NOTE {note}", highlight=False, markup=False, soft_wrap=True)
    for fault in result.faults:
        console.print(f"FAULT {fault}", style="red", highlight=False, markup=False, soft_wrap=True)


def cell_tables(check: CellCheck) -> Iterator[Table]:
    """Arms, what a stop asks of them, obstacles, the nearest pairs, and what the hands' controls do."""
    yield from map(arm_table, check.arms)
    yield from map(_stop_table, check.stop_torques)
    obstacles: list[tuple[Cell, ...]] = [
        (name, obstacle.shape, _numbers(obstacle.size), _numbers(obstacle.position))
        for name, obstacle in check.obstacles.items()
    ]
    floor: list[tuple[Cell, ...]] = [] if check.floor is None else [("floor", "plane", "", f"0 0 {check.floor:g}")]
    title = "obstacles" if obstacles or floor else "no obstacles, no floor"
    yield figure_table(title, ("name", "shape", "size [m]", "centre [m]"), obstacles + floor)
    yield pair_table(check)
    yield figure_table("controls of each hand", ("control", "does"), check.controls.items())


def arm_table(arm: ArmCheck) -> Table:
    """One arm's joints and limits."""
    position = " ".join(f"{value:.3f}" for value in arm.tool_position)
    flange = "" if arm.flange is None else f", flange {arm.flange}"
    tool = f"tool {arm.tool_model or 'none'}; {arm.tool_frame} at home at {position} m"
    return figure_table(
        f"{arm.name} arm: {arm.model}{flange}, {tool}",
        ("joint", "min [rad]", "home [rad]", "max [rad]", "speed [rad/s]", "torque [Nm]"),
        (
            (joint.name, *map("{:.3f}".format, (joint.lower, joint.home, joint.upper, joint.velocity, joint.torque)))
            for joint in arm.joints
        ),
    )


def _stop_table(stop: StopTorque) -> Table:
    """Torques that a full stop of one arm needs."""
    return figure_table(
        f"{stop.arm} arm: most torque in {stop.postures} random postures, of each joint's limit",
        ("joint", "stops at [rad/s^2]", "gravity [%]", "full stop [%]"),
        (
            (joint.joint, joint.acceleration, f"{100 * joint.gravity:.0f}", f"{100 * joint.stop:.0f}")
            for joint in stop.joints
        ),
    )


def pair_table(check: CellCheck) -> Table:
    """The nearest pairs at home."""
    return figure_table(
        f"nearest of {check.monitored_pairs} monitored pairs at home, min_distance {1e3 * check.min_distance:g} mm",
        ("pair", "distance [mm]", "kept [mm]"),
        (
            (f"{pair.name_a} | {pair.name_b}", f"{1e3 * pair.distance:.1f}", f"{1e3 * pair.kept:g}")
            for pair in check.nearest
        ),
    )


def pair_reach_table(pairs: PairsWritten) -> Table:
    """Which pairs of links cannot meet."""
    return figure_table(
        f"{pairs.file}: {len(pairs.never)} of {len(pairs.never) + len(pairs.watched)} pairs of links stay more than "
        f"{1e3 * pairs.clearance:g} mm apart",
        ("pair", "nearest found [mm]"),
        ((f"{pair.link_a} | {pair.link_b}", f"{1e3 * pair.nearest:.0f}") for pair in pairs.never),
    )


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
