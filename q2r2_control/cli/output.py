"""Output of commands: JSON on stdout, and all else on stderr or as tables."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

_NOTICE_AFTER = 3.0  # [s]


def as_json_text(value: Any) -> str:
    """``value`` as strict JSON: dataclasses and mappings as objects, arrays as lists, what is not finite as null."""
    return json.dumps(_jsonable(value), allow_nan=False)


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _jsonable(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def stderr_console() -> Console:
    """For what is not a command's result."""
    return Console(stderr=True)


def print_report(data: Any, tables: Iterable[Table], json: bool) -> None:
    """Print a command's result on stdout: ``data`` as one JSON object, or the ``tables``."""
    if json:
        print(as_json_text(data))
        return
    console = Console()
    for table in tables:
        console.print(table)


def say(line: str, console: Console | None = None, style: str = "") -> None:
    """Print one line on stderr as it is, however long."""
    console = console or stderr_console()
    console.print(line, style=style, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def counting(what: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """Show how far a long work has got, where stderr is a terminal.

    The function that it yields takes what is counted (``what`` by default), how many are done, and how many there are.
    """
    console = stderr_console()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda of, done, total: progress.update(task, description=of or what, completed=done, total=total)


def print_progress(what: str) -> None:
    """Print a line on stderr, where that is a terminal; a live line would need a thread, which adds to times."""
    console = stderr_console()
    if console.is_terminal:
        console.print(what, highlight=False)


@contextmanager
def notice_of_compiling(console: Console) -> Iterator[None]:
    """Say what takes so long, where building the controller does."""
    text = "building the controller; where its code is new it is compiled for this machine first, 1-2 minutes"
    timer = threading.Timer(_NOTICE_AFTER, lambda: console.print(text, soft_wrap=True, highlight=False))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
