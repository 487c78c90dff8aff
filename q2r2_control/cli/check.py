"""``q2r2 check``: print the parts of a cell and its faults."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.table import Table
from typer import Exit, Option

from q2r2_control.cli.cell_report import CellCheck, check_cell, verdict_on
from q2r2_control.cli.output import ConfigFile, Json, as_json_text, counting, print_report, say
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.process.folders import check_file
from q2r2_control.robot.reachability import PairReach, Progress, nearest_approaches, srdf_of
from q2r2_control.robot.robot import Robot
from q2r2_control.viewer.tables import figure_table, print_table


@dataclass(frozen=True, slots=True)
class PairsWritten:
    """The smallest distances of the monitored pairs of links in random postures [m]."""

    file: str
    samples: int
    clearance: float
    never: tuple[PairReach, ...]  # The pairs that stay farther apart than ``clearance``, with the farthest pair last.
    watched: tuple[PairReach, ...]  # All other pairs, with the nearest pair first.


def write_pairs(
    config: Config, file: Path, samples: int, clearance: float, progress: Progress | None = None
) -> PairsWritten:
    """Find, in random postures, which pairs of a cell can meet. Write the other pairs as an SRDF into a new ``file``.

    Raises :class:`ConfigError` if the file exists or cannot be written, or if the clearance is not above all distances
    in ``control``.
    """
    key, least = config.control.largest_distance
    if not least < clearance <= 1.0:
        raise ConfigError(f"clearance = {clearance:g} m: allowed: above control.{key}, {least:g}, up to 1")
    if file.exists():
        raise ConfigError(f"{file}: exists; give the name of a new file")
    check_file(file, "--pairs")
    robot = Robot.from_config(config)
    found = nearest_approaches(robot, samples, 0, clearance, progress)
    try:
        file.write_text(srdf_of(robot, found, clearance, samples), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error}") from error
    never = tuple(pair for pair in found if pair.nearest > clearance)
    return PairsWritten(str(file), samples, clearance, never, tuple(pair for pair in found if pair not in never))


def check(
    config: ConfigFile,
    pairs: Annotated[
        Path | None, Option(metavar="FILE", help="Write the pairs that can never meet into an SRDF file.")
    ] = None,
    samples: Annotated[int, Option(help="Number of random postures that --pairs examines.")] = 20_000,
    clearance: Annotated[
        float, Option(help="With --pairs: pairs that stay farther apart are not monitored [m].")
    ] = 0.05,
    json: Json = False,
) -> None:
    """Validate a cell and print its arms, limits, obstacles and distances at home.

    Exit code 1 if the cell cannot run, 2 if it cannot be read.
    """
    if pairs is not None:
        cell = load_config(config)
        with counting() as progress:
            found = write_pairs(cell, pairs, samples, clearance, progress)
        table = figure_table(
            f"{pairs}: {len(found.never)} of {len(found.never) + len(found.watched)} pairs of links stay more than "
            f"{1e3 * clearance:g} mm apart",
            ("pair", "nearest found [mm]"),
            ((f"{pair.link_a} | {pair.link_b}", 1e3 * pair.nearest) for pair in found.never),
        )
        print_report(found, (table,), json)
    else:
        with _verdict_on_refusal(config, json):
            result = check_cell(load_config(config))
        if json:
            print(as_json_text(result))
        else:
            _print_cell(result)
        raise Exit(1 if result.faults else 0)


@contextmanager
def _verdict_on_refusal(file: str, json: bool) -> Iterator[None]:
    """If the cell cannot be built, print its faults and the verdict. The exit code is 2, as for all errors."""
    try:
        yield
    except Q2R2Error as error:
        for fault in error.faults:
            say(f"q2r2: {fault}")
        verdict = verdict_on(error.faults)
        print(as_json_text({"file": file, "faults": error.faults, "verdict": verdict}) if json else verdict)
        raise Exit(2) from error


def _print_cell(cell: CellCheck) -> None:
    """Print the arms, their torques in a stop, the obstacles, the nearest pairs, and what each hand's controls do."""
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"cell {cell.name}")
    for table in _cell_tables(cell):
        print_table(table, console)
    for arm, line in (cell.driven or {"arms": "the built-in controller"}).items():
        console.print(f"{arm} driven by {line}", markup=False)
    for note in cell.notes:
        console.print(f"NOTE {note}", markup=False)
    for fault in cell.faults:
        console.print(f"FAULT {fault}", style="red", markup=False)
    for line in cell.remedies:
        console.print(line, markup=False)
    console.print(cell.verdict, style="red" if cell.faults else "green", markup=False)


def _cell_tables(cell: CellCheck) -> Iterator[Table]:
    for arm in cell.arms:
        flange = "" if arm.flange is None else f", flange {arm.flange}"
        at = " ".join(f"{value:.3f}" for value in arm.tool_position)
        yield figure_table(
            f"{arm.name} arm: {arm.model}{flange}, tool {arm.tool_model or 'none'}; {arm.tool_frame} at home at {at} m",
            ("joint", "min [rad]", "home [rad]", "max [rad]", "speed [rad/s]", "torque [Nm]"),
            ((name, *(f"{value:.3f}" for value in values)) for name, *values in map(dict.values, arm.joints)),
        )
    for stop in cell.stop_torques:
        yield figure_table(
            f"{stop.arm} arm: most torque in {stop.postures} random postures, of each joint's limit",
            ("joint", "stops at [rad/s^2]", "gravity [%]", "full stop [%]"),
            ((joint.joint, joint.acceleration, 100 * joint.gravity, 100 * joint.stop) for joint in stop.joints),
        )
    bodies: list[tuple[str, ...]] = [
        (name, body.shape, " ".join(map(str, body.size)), " ".join(map(str, body.position)))
        for name, body in cell.obstacles.items()
    ]
    if cell.floor is not None:
        bodies.append(("floor", "plane", "", f"0 0 {cell.floor:g}"))
    title = "obstacles" if bodies else "no obstacles, no floor"
    yield figure_table(title, ("name", "shape", "size [m]", "centre [m]"), bodies)
    yield figure_table(
        f"nearest of {cell.monitored_pairs} monitored pairs at home, min_distance {1e3 * cell.min_distance:g} mm",
        ("pair", "distance [mm]", "kept [mm]"),
        ((f"{pair.name_a} | {pair.name_b}", 1e3 * pair.distance, 1e3 * pair.kept) for pair in cell.nearest),
    )
    yield figure_table("controls of each hand", ("control", "does"), cell.controls.items())
