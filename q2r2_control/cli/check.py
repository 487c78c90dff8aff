"""``q2r2 check``: what a cell consists of, and what is wrong with it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.cli.cell_report import check_cell, write_pairs
from q2r2_control.cli.options import ConfigFile, Json
from q2r2_control.cli.output import as_json_text, notice_of_compiling, stderr_console
from q2r2_control.cli.tables import arm_table, obstacle_table, pair_reach_table, pair_table
from q2r2_control.config import load_config


def check(
    config: ConfigFile,
    pairs: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Find pairs that can never meet and write them as an SRDF for the key srdf."),
    ] = None,
    samples: Annotated[int, typer.Option(help="Random postures that --pairs looks at.")] = 20_000,
    clearance: Annotated[float, typer.Option(help="Pairs that stay farther apart need no watching [m].")] = 0.05,
    json: Json = False,
) -> None:
    """Validate a cell and print its arms, limits, obstacles and distances at home; exit 1 where home is unsafe."""
    if pairs is not None:
        found = write_pairs(load_config(config), pairs, samples, clearance)
        if json:
            print(as_json_text(asdict(found)))
        else:
            Console().print(pair_reach_table(found))
        return
    with notice_of_compiling(stderr_console()):
        result = check_cell(load_config(config))
    if json:
        print(as_json_text(result.as_json()))
    else:
        console = Console()
        console.print(f"cell {result.name}", highlight=False)
        for table in (*map(arm_table, result.arms), obstacle_table(result), pair_table(result)):
            console.print(table)
        for arm, line in (result.driven or {"arms": "the built-in controller"}).items():
            console.print(f"{arm} driven by {line}", highlight=False, markup=False, soft_wrap=True)
        for fault in result.faults:
            console.print(f"FAULT {fault}", style="red", highlight=False, soft_wrap=True)
    raise typer.Exit(1 if result.faults else 0)
