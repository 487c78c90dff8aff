"""One HTML page of judged episodes that needs nothing else: styles and pictures are in it."""

from __future__ import annotations

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
        name, badge = f"{number}. {escape(judged.figures.name)}", _badge(judged)
        cells = "".join(f"<td>{column.text(judged.figures)}</td>" for column in COLUMNS)
        rows.append(f'<tr><th><a href="#episode-{number}">{name}</a></th><td>{badge}</td>{cells}</tr>')
        reasons = "".join(f"<li>{escape(reason.text)}</li>" for reason in judged.verdict.reasons)
        about = f"<p>{escape(judged.figures.task)}</p><ul>{reasons}</ul>"
        sections.append(f'<section id="episode-{number}"><h2>{name} {badge}</h2>{about}{_picture(judged)}</section>')
        progress(number)
    kept = sum(judged.verdict.keep for judged in episodes)
    return _PAGE.format(
        title=escape(title),
        count=f"episodes: {len(episodes)}, of which {kept} kept and {len(episodes) - kept} discarded",
        style=_STYLE,
        headings="".join(f"<th>{escape(column.heading)}</th>" for column in COLUMNS),
        rows="\n".join(rows),
        sections="\n".join(sections),
    )


def _picture(judged: Judged) -> str:
    """As an image of its own, since names of elements are the same in all of them."""
    data = b64encode(draw_episode(judged).encode()).decode()
    alt = escape(f"plots of {judged.figures.name}")
    return f'<img alt="{alt}" width="1248" height="806" src="data:image/svg+xml;base64,{data}">'


def _badge(judged: Judged) -> str:
    word = judged.verdict.word
    return f'<b class="{word}">{"&#10003;" if judged.verdict.keep else "&#10007;"} {word}</b>'


_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1280px; margin: 1.5rem auto; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 13px; } tbody tr:nth-child(odd) { background: #f4f5f7; }
th, td { padding: .3rem .5rem; text-align: right; } th { text-align: left; } section img { width: 100%; height: auto; }
.keep { color: #1f6fb2; } .discard, li { color: #b04a00; }
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
<p>{count}; of several hands or arms the worst number counts</p>
<table>
<thead><tr><th>episode</th><th>verdict</th>{headings}</tr></thead>
<tbody>
{rows}
</tbody></table>
{sections}
</body>
</html>
"""
