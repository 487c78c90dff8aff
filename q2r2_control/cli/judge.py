"""``q2r2 judge`` and ``q2r2 report``: which recorded episodes are fit to be learned from, and why others are not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from q2r2_control.cli.output import Json, as_json_text, counting, figure_table
from q2r2_control.cli.summary_table import verdict_markup
from q2r2_control.config.cell import load_config
from q2r2_control.config.recording import JudgeSettings
from q2r2_control.errors import ConfigError
from q2r2_control.judging.judge import Judged, judge_all
from q2r2_control.judging.page import COLUMNS, page_of
from q2r2_control.recording.reader import recordings_in

_SHOWN = ("success", "time", "idle", "gap", "delay", "error", "LDLJ")  # what a terminal has room for; the page has all

Recordings = Annotated[list[Path], typer.Argument(metavar="DIR_OR_FILES...", help="Recordings, or folders of them.")]
Thresholds = Annotated[
    str | None, typer.Option(metavar="CONFIG", help="A cell's YAML whose thresholds to use, not the recorded cell's.")
]


def judge(recordings: Recordings, config: Thresholds = None, json: Json = False) -> None:
    """Say of each recorded episode whether to keep or to discard it, why, and by which numbers.

    Thresholds are those of the recorded cell, its block `judge`. Exit code 2 for a file that is no recording.
    """
    judged = _judged(recordings, config)
    if json:
        print(as_json_text({"episodes": [one.as_json() for one in judged]}))
        return
    console = Console()
    console.print(_table(judged))
    for one in judged:
        if not one.verdict.keep:
            name = one.figures.file + ("" if one.figures.part is None else f" #{one.figures.part}")
            console.print(f"{escape(name)}: {verdict_markup(one.verdict)}", soft_wrap=True, highlight=False)


def report(
    recordings: Recordings,
    output: Annotated[Path, typer.Option(metavar="HTML", help="The page to write; one that exists is replaced.")],
    config: Thresholds = None,
) -> None:
    """Write one HTML page of recorded episodes: verdicts, numbers and plots. It needs no network to be looked at."""
    if output.is_dir() or not output.parent.is_dir():
        raise ConfigError(f"--output {output}: allowed: a file in a folder that exists")
    judged, names = _judged(recordings, config), ", ".join(map(str, recordings))
    with counting("plots") as progress:
        page = page_of(judged, f"Recordings: {names}", lambda done: progress("", done, len(judged)))
    try:
        output.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--output {output}: {error.strerror}") from error
    kept = sum(one.verdict.keep for one in judged)
    print(f"{output}: {len(judged)} episodes, {kept} kept, {len(judged) - kept} discarded")


def _judged(recordings: Sequence[Path], config: str | None) -> list[Judged]:
    settings: JudgeSettings | None = None if config is None else load_config(config).judge
    files, judged = recordings_in(recordings), list[Judged]()
    with counting("recordings") as progress:
        for one in judge_all(files, settings):
            judged.append(one)
            progress("", len(judged), max(len(judged), len(files)))
    return judged


def _table(judged: Sequence[Judged]) -> Table:
    """A row for each episode; of several hands or arms the worst number."""
    kept = sum(one.verdict.keep for one in judged)
    columns = [column for column in COLUMNS if column.name in _SHOWN]
    headings = tuple(column.heading for column in columns)
    return figure_table(
        f"episodes: {kept} kept, {len(judged) - kept} discarded",
        ("episode", "verdict", *headings),
        ((one.figures.name, one.verdict.word, *(column.text(one.figures) for column in columns)) for one in judged),
    )
