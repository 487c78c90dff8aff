"""``q2r2 check``: what a cell consists of, and what is wrong with it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from q2r2_control.cli.cell_report import CellCheck, check_cell, write_model_pairs, write_pairs
from q2r2_control.cli.options import ConfigFile, Json
from q2r2_control.cli.output import as_json_text, notice_of_compiling, stderr_console
from q2r2_control.cli.progress_lines import ProgressLines
from q2r2_control.cli.tables import (
    arm_table,
    control_table,
    model_pairs_table,
    obstacle_table,
    pair_reach_table,
    pair_table,
    stop_table,
)
from q2r2_control.config.cell import load_config
from q2r2_control.errors import ConfigError


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
    if pairs is not None:
        progress = ProgressLines(stderr_console())
        found = write_pairs(load_config(config), pairs, samples, clearance, progress=progress)
        _print(asdict(found), pair_reach_table(found), json)
        return
    if model_pairs is not None:
        progress = ProgressLines(stderr_console())
        files = write_model_pairs(load_config(config), model_pairs, samples, clearance, progress=progress)
        _print(files, model_pairs_table(files), json)
        return
    result = check_cell(load_config(config), notice_of_compiling(stderr_console()))
    if json:
        print(as_json_text(result.as_json()))
    else:
        _print_cell(result)
    raise typer.Exit(1 if result.faults else 0)


def _print_cell(result: CellCheck) -> None:
    console = Console()
    console.print(f"cell {result.name}", highlight=False)
    for table in (
        *map(arm_table, result.arms),
        *map(stop_table, result.stop_torques),
        obstacle_table(result),
        pair_table(result),
        control_table(result),
    ):
        console.print(table)
    for arm, line in (result.driven or {"arms": "the built-in controller"}).items():
        console.print(f"{arm} driven by {line}", highlight=False, markup=False, soft_wrap=True)
    for note in result.notes:
        console.print(f"NOTE {note}", highlight=False, markup=False, soft_wrap=True)
    for fault in result.faults:
        console.print(f"FAULT {fault}", style="red", highlight=False, markup=False, soft_wrap=True)


def _print(data: dict[str, Any], table: Table, json: bool) -> None:
    if json:
        print(as_json_text(data))
    else:
        Console().print(table)
