"""Lines that tell how far a long search has got."""

from __future__ import annotations

import io

from rich.console import Console

from q2r2_control.cli.progress_lines import ProgressLines


def test_a_line_is_printed_now_and_then_also_where_nobody_watches() -> None:
    now, out = 0.0, io.StringIO()
    progress = ProgressLines(Console(file=out, force_terminal=False), period=3.0, clock=lambda: now)
    for done in range(1, 1001):
        now = 0.01 * done
        progress("pairs followed downhill", 10 * done, 10_000)
    assert out.getvalue().splitlines() == [
        f"pairs followed downhill: {done:,} of 10,000" for done in (3_000, 6_000, 9_000)
    ]
