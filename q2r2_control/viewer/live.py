"""The live table of a run. A thread draws the table, so that the loop only has to keep the newest tick."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.arm_words import ArmWords
from q2r2_control.viewer.episode_words import EpisodeWords
from q2r2_control.viewer.tables import times_real_time
from q2r2_control.wording import limit_name

_REFRESH_RATE = 6.0  # Rate at which the table is drawn [Hz].
# The thread that draws may compute for milliseconds. After this time [s], it has to give the interpreter to the loop.
_SWITCH_INTERVAL = 2e-5
_LIMITS_SHOWN, _BAR = 4, 20  # Greatest number of limits that are named, and length of the progress bar [characters].
_NAMES = len("gripper opening")  # Width of the column with the names of rows. No name is longer [characters].
_WIDEST = 120  # The table is no wider than this [characters].
_NEAR = 0.01  # A pair with a smaller margin is coloured [m].


class LiveTable:
    """Shows the newest tick of a run."""

    def __init__(
        self,
        title: str,
        words: ArmWords,
        steps: Sequence[tuple[float, str]] = (),
        duration: float | None = None,
        *,
        simulated_time: bool = False,
        episodes: EpisodeWords | None = None,
    ) -> None:
        """Prepare the table; ``words`` makes the sentences about the run's arms.

        ``steps`` are the steps of the work, each with its start [s] and its name, for a run with a known ``duration``
        [s]. If ``simulated_time`` is True, the table compares the speed of the run with real time. ``episodes`` makes
        the words about episodes of a recorded run.
        """
        self._title, self._words = title, words
        self._steps, self._duration = steps, duration
        self._newest: Tick | None = None
        self._count = 0  # Number of ticks so far.
        self._binding: dict[ActiveLimit, None] = {}  # Limits that held a step back since the last drawing.
        self._repelled: dict[str, None] = {}  # Joints that were pushed off their limits since the last drawing.
        self._simulated_time, self._episodes = simulated_time, episodes
        # The last drawing: its time [s], the number of ticks until then, and the time of the run [s].
        self._drawn = (time.monotonic(), 0, 0.0)

    def __call__(self, tick: Tick) -> None:
        """Store one tick, to be shown later."""
        self._newest = tick
        self._count += 1
        self._binding.update(dict.fromkeys(tick.reference.report.binding))
        if tick.impedance is not None:
            self._repelled.update(dict.fromkeys(tick.impedance.repelled))
        self._words.follow(tick.events)
        if self._episodes is not None:
            self._episodes.follow(tick.events)

    @contextmanager
    def shown(self, console: Console) -> Iterator[None]:
        """Show the table on ``console`` for as long as the context lasts, if it is a terminal.

        Lines that are printed during this time appear above the table. The loop must print nothing, because it would
        wait for the terminal.
        """
        if not console.is_terminal:
            yield
            return
        before = sys.getswitchinterval()
        sys.setswitchinterval(min(before, _SWITCH_INTERVAL))
        live = Live(
            console=console,
            get_renderable=lambda: self._drawn_table(console.width),
            refresh_per_second=_REFRESH_RATE,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
        )
        live.start()
        try:
            yield
        finally:
            sys.setswitchinterval(before)
            with suppress(OSError):  # Printing fails if the terminal was closed.
                live.stop()

    def _drawn_table(self, width: int) -> Table | str:
        try:
            return self.render(min(width, _WIDEST))
        except Exception as error:
            return f"no live table: {type(error).__name__}: {error}"

    def render(self, width: int) -> Table:
        """Return the table at this moment, with columns whose widths depend only on ``width`` [characters]."""
        tick, (then, counted, reached), now = self._newest, self._drawn, time.monotonic()
        self._drawn = now, self._count, 0.0 if tick is None else tick.t
        passed = max(now - then, 1e-9)
        loop = f"{(self._drawn[1] - counted) / passed:.0f} Hz"
        if self._simulated_time:
            loop += f", {times_real_time((self._drawn[2] - reached) / passed)}"
        table = Table(title=self._title, title_justify="left", width=width)
        table.add_column("", style="dim", min_width=_NAMES)
        if tick is None:
            table.add_row("starting")
            return table
        arms = list(tick.tools)
        for heading in (*arms, "")[:2]:
            # Columns of equal shares do not change their widths as their texts change.
            table.add_column(heading, justify="right", min_width=14, overflow="fold", ratio=1)
        if self._duration is not None:
            done = min(tick.t / self._duration, 1.0)
            bar = "━" * round(_BAR * done) + "·" * (_BAR - round(_BAR * done))
            step = next((words for begins, words in reversed(self._steps) if begins <= tick.t), "")
            table.add_row("progress", step, f"{bar} {done:.0%}")
        binding, self._binding = list(self._binding), {}
        repelled, self._repelled = list(self._repelled), {}
        for name, values in _arm_rows(tick, arms):
            table.add_row(name, *values)
        if tick.sessions:
            table.add_row("cabinet", *(tick.sessions[arm] for arm in arms))
        table.add_row("why", *(escape(self._words.why(tick, arm, binding)) for arm in arms))
        table.add_row("next", *(escape(self._words.next_press(tick, arm)) for arm in arms))
        table.add_section()
        report = tick.reference.report
        names = [*map(limit_name, binding), *(f"{joint} pushed off its limit" for joint in repelled)]
        more = f" and {len(names) - _LIMITS_SHOWN} more" if len(names) > _LIMITS_SHOWN else ""
        colour = "yellow" if report.margin < _NEAR else "default"
        rows = {
            "time, loop": (f"{tick.t:.1f} s", f"{loop}, {1e6 * tick.compute_time:.0f} us a tick"),
            "nearest pair": (f"{1e3 * report.closest_distance:.1f} mm", " | ".join(report.closest_pair)),
            "tightest pair": (f"[{colour}]{1e3 * report.margin:.1f} mm to spare[/]", " | ".join(report.tightest_pair)),
            "status": (str(report.status), "a stop is certified" if report.certified else "[red]no certified stop[/]"),
            "limits at work": (str(len(names)), ", ".join(names[:_LIMITS_SHOWN]) + more or "-"),
        }
        for arm, pair in tick.held_grippers.items():
            rows[f"{arm} gripper"] = ("[yellow]held[/]", " | ".join(pair))
        for name, (first, second) in rows.items():
            table.add_row(name, first, second)
        if self._episodes is not None:
            table.add_row("recording", "", escape(self._episodes.text))
        return table


def _arm_rows(tick: Tick, arms: list[str]) -> list[tuple[str, list[str]]]:
    errors = {arm: tick.tracking_error(arm) for arm in arms}
    return [
        ("teleop", [f"[green]{tick.states[arm]}[/]" if tick.engaged[arm] else tick.states[arm] for arm in arms]),
        ("position error", [_figure(1e3 * errors[arm][0], "mm", 1) for arm in arms]),
        ("rotation error", [_figure(np.degrees(errors[arm][1]), "deg", 2) for arm in arms]),
        (escape("tool x y z [m]"), ["{:.3f} {:.3f} {:.3f}".format(*tick.tools[arm].translation) for arm in arms]),
        ("gripper opening", [_figure(100.0 * tick.grippers.get(arm, np.nan), "%", 0) for arm in arms]),
    ]


def _figure(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}" if np.isfinite(value) else "-"
