"""One HTML page of judged episodes that needs nothing else: styles, script and pictures are in it."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from q2r2_control.judging.figures import EpisodeFigures
from q2r2_control.judging.judge import Judged
from q2r2_control.judging.plots import draw_episode


@dataclass(frozen=True, slots=True)
class FigureColumn:
    """A number of the table of episodes; of several hands or arms the worst one."""

    name: str
    unit: str
    digits: int
    value: Callable[[EpisodeFigures], float | None]
    words: tuple[str, ...] = ()  # in place of the numbers 0, 1 and so on

    @property
    def heading(self) -> str:
        """With the unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def text(self, figures: EpisodeFigures) -> str:
        """The number, or a dash where there is nothing to tell it by."""
        value = self.value(figures)
        if value is None:
            return "-"
        return self.words[int(value)] if self.words else f"{value:.{self.digits}f}"


def _worst(values: Sequence[float | None], worst: Callable[..., float] = max) -> float | None:
    known = [value for value in values if value is not None]
    return worst(known) if known else None


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


COLUMNS = (
    FigureColumn("success", "", 0, lambda of: None if of.success is None else float(of.success), ("no", "yes")),
    FigureColumn("time", "s", 1, lambda of: of.duration_s),
    FigureColumn("engaged", "s", 1, lambda of: of.engaged_s),
    FigureColumn("idle", "%", 0, lambda of: _percent(of.idle_share)),
    FigureColumn("poses", "Hz", 0, lambda of: _worst([hand.pose_rate_hz for hand in of.hands.values()], min)),
    FigureColumn("gap", "s", 3, lambda of: _worst([hand.longest_gap_s for hand in of.hands.values()])),
    FigureColumn("delay", "ms", 0, lambda of: _worst([arm.hand_to_tool_ms for arm in of.arms.values()])),
    FigureColumn("error", "mm RMS", 1, lambda of: _worst([arm.position_error_mm_rms for arm in of.arms.values()])),
    FigureColumn("leashed", "%", 0, lambda of: _percent(_worst([arm.leashed_share for arm in of.arms.values()]))),
    FigureColumn("LDLJ", "", 1, lambda of: _worst([arm.ldlj for arm in of.arms.values()], min)),
    FigureColumn("nearest", "mm", 1, lambda of: of.min_distance_mm),
    FigureColumn("faults", "", 0, lambda of: float(len(of.faults))),
    FigureColumn("lost", "ticks", 0, lambda of: float(of.timing.lost_ticks)),
    FigureColumn("missed", "%", 1, lambda of: _percent(of.timing.missed_share)),
)


def page_of(episodes: Sequence[Judged], title: str, progress: Callable[[int], None] = lambda done: None) -> str:
    """The page; ``progress`` is told how many episodes are drawn."""
    rows, sections = [], []
    for number, judged in enumerate(episodes, 1):
        rows.append(_row(judged, number))
        sections.append(_section(judged, number))
        progress(number)
    kept = sum(judged.verdict.keep for judged in episodes)
    headings = "".join(f'<th class="number">{escape(column.heading)}</th>' for column in COLUMNS)
    return _PAGE.format(
        title=escape(title),
        count=f"episodes: {len(episodes)}, of which {kept} kept and {len(episodes) - kept} discarded",
        style=_STYLE,
        headings=headings,
        rows="\n".join(rows),
        sections="\n".join(sections),
        script=_SCRIPT,
    )


def _row(judged: Judged, number: int) -> str:
    word = judged.verdict.word
    cells = "".join(
        f'<td class="number" data-value="{_sortable(column.value(judged.figures))}">{column.text(judged.figures)}</td>'
        for column in COLUMNS
    )
    return (
        f'<tr><td class="number" data-value="{number}">{number}</td>'
        f'<td><a href="#episode-{number}">{escape(judged.figures.name)}</a></td><td>{_badge(word)}</td>{cells}</tr>'
    )


def _section(judged: Judged, number: int) -> str:
    figures, word = judged.figures, judged.verdict.word
    reasons = "".join(f"<li>{escape(reason.text)}</li>" for reason in judged.verdict.reasons)
    task = f'<p class="task">{escape(figures.task)}</p>' if figures.task else ""
    why = f"<ul>{reasons}</ul>" if reasons else ""
    return (
        f'<section id="episode-{number}">'
        f"<h2>{number}. {escape(judged.figures.name)} {_badge(word)}</h2>{task}{why}{_picture(judged)}</section>"
    )


def _picture(judged: Judged) -> str:
    """As an image of its own, since names of elements are the same in all of them."""
    data = b64encode(draw_episode(judged).encode()).decode()
    alt = escape(f"plots of {judged.figures.name}")
    return f'<img alt="{alt}" width="1248" height="806" src="data:image/svg+xml;base64,{data}">'


def _badge(word: str) -> str:
    return f'<span class="{word}">{"&#10003;" if word == "keep" else "&#10007;"} {word}</span>'


def _sortable(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else repr(value)


_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; background: #fafafa; margin: 1.5rem auto; max-width: 1280px;
  padding: 0 1rem; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.15rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
.table { overflow-x: auto; background: white; border: 1px solid #ddd; border-radius: 6px; }
table { border-collapse: collapse; width: 100%; font-size: 13px; }
th, td { padding: .35rem .55rem; text-align: left; border-bottom: 1px solid #eee; white-space: nowrap; }
th { background: #f0f2f5; cursor: pointer; white-space: normal; vertical-align: bottom; user-select: none; }
th[data-order="1"]::after { content: " \\25b2"; } th[data-order="-1"]::after { content: " \\25bc"; }
.number { text-align: right; font-variant-numeric: tabular-nums; }
.keep, .discard { font-weight: 600; white-space: nowrap; } .keep { color: #1f6fb2; } .discard { color: #b04a00; }
section { background: white; border: 1px solid #ddd; border-radius: 6px; margin: 1.2rem 0; padding: .9rem 1.1rem; }
section ul { margin: .3rem 0; color: #b04a00; } section img { width: 100%; height: auto; }
.task { margin: 0; color: #555; }
@media print { section { break-inside: avoid; } }
"""

_SCRIPT = """
const table = document.querySelector("table"), body = table.tBodies[0];
const heads = [...table.tHead.rows[0].cells];
function valueOf(row, column) {
  const cell = row.cells[column];
  if (!("value" in cell.dataset)) return cell.textContent;
  return cell.dataset.value === "" ? null : Number(cell.dataset.value);
}
function compare(a, b) {
  return typeof a === "number" ? a - b : a.localeCompare(b);
}
heads.forEach((head, column) => head.addEventListener("click", () => {
  const order = head.dataset.order === "1" ? -1 : 1;
  heads.forEach(other => delete other.dataset.order);
  head.dataset.order = order;
  const rows = [...body.rows].map(row => [valueOf(row, column), row]);
  // Numbers that there are none of come last, whichever way.
  rows.sort(([a], [b]) => a === null || b === null ? (a === null) - (b === null) : order * compare(a, b));
  body.append(...rows.map(([, row]) => row));
}));
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<h1>{title}</h1>
<p>{count}</p>
<p>a click on a heading sorts; of several hands or arms the worst number counts</p>
<div class="table"><table>
<thead><tr><th>#</th><th>episode</th><th>verdict</th>{headings}</tr></thead>
<tbody>
{rows}
</tbody></table></div>
{sections}
<script>{script}</script>
</body>
</html>
"""
