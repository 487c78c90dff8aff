"""Make one HTML page of judged episodes that needs no other files: it contains its styles and pictures."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from q2r2_control.judging.episode import stretches
from q2r2_control.judging.figures import EpisodeFigures
from q2r2_control.judging.judge import Judged, Unreadable
from q2r2_control.judging.motion import tracking_errors
from q2r2_control.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {"left": "#1f6fb2", "right": "#d9722b"}
# The line of the right arm is dashed, because it is drawn over the line of the left arm.
_LINE_STYLES: dict[str, Any] = {"left": "-", "right": (0, (4, 3))}
_POINTS = 500  # The largest number of points of a line.
_SPEED_OVER = 5  # The number of frames over which a speed is averaged.
_SHADE: dict[str, Any] = {"color": "#b0b0b0", "alpha": 0.35, "linewidth": 0.0}
_LOST: dict[str, Any] = {"color": "#b3202c", "alpha": 0.4, "linewidth": 0.0}
_FAULT: dict[str, Any] = {"color": "#6a4c93", "linestyle": "-.", "linewidth": 1.4}
_LIMIT: dict[str, Any] = {"color": "#b3202c", "linestyle": "--", "linewidth": 1.2}


@dataclass(frozen=True, slots=True)
class FigureColumn:
    """A column of the table of episodes. If an episode has several hands or arms, it shows the worst number."""

    name: str
    unit: str
    digits: int
    value: Callable[[EpisodeFigures], float | str | None]

    @property
    def heading(self) -> str:
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def text(self, figures: EpisodeFigures) -> str:
        value = self.value(figures)
        if value is None:
            return "-"
        return value if isinstance(value, str) else f"{value:.{self.digits}f}"


def _worst(values: Sequence[float | None], worst: Callable[..., float] = max) -> float | None:
    known = [value for value in values if value is not None]
    return worst(known) if known else None


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


COLUMNS = (
    FigureColumn("success", "", 0, lambda of: None if of.success is None else "yes" if of.success else "no"),
    FigureColumn("time", "s", 1, lambda of: of.duration_s),
    FigureColumn("engaged", "s", 1, lambda of: of.engaged_s),
    FigureColumn("subtasks", "", 0, lambda of: float(len(of.subtasks)) if of.subtasks else None),
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


def page_of(
    episodes: Sequence[Judged],
    title: str,
    progress: Callable[[int], None] = lambda done: None,
    unreadable: Sequence[Unreadable] = (),
) -> str:
    """Return the HTML text of the page. The files that are ``unreadable`` are listed at its end.

    ``progress`` is called with the number of episodes whose plots are drawn so far.
    """
    rows, sections = [], []
    for number, judged in enumerate(episodes, 1):
        plain, word = escape(judged.figures.name), judged.verdict.word
        name, mark = f"{number}. {plain}", "&#10003;" if judged.verdict.keep else "&#10007;"
        badge = f'<b class="{word}">{mark} {word}</b>'
        cells = "".join(f"<td>{column.text(judged.figures)}</td>" for column in COLUMNS)
        rows.append(f'<tr><th><a href="#episode-{number}">{name}</a></th><td>{badge}</td>{cells}</tr>')
        reasons = "".join(f"<li>{escape(reason.text)}</li>" for reason in judged.verdict.reasons)
        about = f"<p>{escape(judged.figures.task or '')}</p><ul>{reasons}</ul>"
        # Each SVG file is embedded as an image of its own, because the same ids of elements occur in all of them.
        data = b64encode(draw_episode(judged).encode()).decode()
        size = 'width="1248" height="806"'
        picture = f'<img alt="plots of {plain}" {size} src="data:image/svg+xml;base64,{data}">'
        sections.append(f'<section id="episode-{number}"><h2>{name} {badge}</h2>{about}{picture}</section>')
        progress(number)
    sections += [f'<p>{escape(str(one.file))}: <b class="discard">{escape(one.line)}</b></p>' for one in unreadable]
    kept = sum(judged.verdict.keep for judged in episodes)
    return _PAGE.format(
        title=escape(title),
        count=f"episodes: {len(episodes)}, of which {kept} kept and {len(episodes) - kept} discarded"
        + (f"; unreadable files: {len(unreadable)}" if unreadable else ""),
        style=_STYLE,
        headings="".join(f"<th>{escape(column.heading)}</th>" for column in COLUMNS),
        rows="\n".join(rows),
        sections="\n".join(sections),
    )


def draw_episode(judged: Judged) -> str:
    """Return plots over time as the text of an SVG file, whose size does not grow with the episode."""
    # Matplotlib is imported only here, because its import takes longer than all work of a command without plots.
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 8.4), layout="constrained")
    canvas = FigureCanvasSVG(figure)
    grid = figure.subplots(3, 2, sharex=True)
    end = float(judged.episode.ticks.t[-1]) if len(judged.episode.ticks.t) else 1.0
    for axes, (draw, title, unit) in zip(grid.flat, _PLOTS, strict=True):
        draw(axes, judged)
        axes.set_title(title)
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
        axes.tick_params(labelbottom=True)
        axes.set_xlim(0.0, max(end, 1e-3))
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)
    for axes in grid[2]:
        axes.set_xlabel("time [s]")
    picture = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "q2r2_control", "path.simplify_threshold": 0.3}):
        canvas.print_svg(picture, metadata={"Date": None, "Creator": None})
    return picture.getvalue()


def thinned(t: Array, values: Array, extreme: np.ufunc) -> tuple[Array, Array]:
    """Return at most 500 points of a line, as their times and values.

    A longer line is divided into 500 parts with equal numbers of points. Each part becomes one point, at the time at
    which the part begins, with the part's extreme value.

    ``extreme`` is ``np.fmax`` or ``np.fmin``.
    """
    if len(t) <= _POINTS:
        return t, values
    starts = np.unique(np.linspace(0, len(t), _POINTS, endpoint=False).astype(int))
    return t[starts], extreme.reduceat(values, starts)


def _draw_speed(axes: Axes, judged: Judged) -> None:
    """Draw the speeds of the measured tools, and a grey background while no arm is engaged."""
    episode, t = judged.episode, judged.episode.frame_t
    for index, arm in enumerate(episode.arms):
        position = episode.tools[:, index, :3]
        if len(t) > _SPEED_OVER:
            passed = np.maximum(t[_SPEED_OVER:] - t[:-_SPEED_OVER], 1e-6)
            speed = np.linalg.norm(position[_SPEED_OVER:] - position[:-_SPEED_OVER], axis=1) / passed
            _draw(axes, arm, 0.5 * (t[_SPEED_OVER:] + t[:-_SPEED_OVER]), 1e3 * speed)
    for number, (begin, stop) in enumerate(stretches(np.asarray(~episode.engaged.any(axis=1)))):
        axes.axvspan(t[begin], t[min(stop, len(t) - 1)], label=None if number else "no arm engaged", **_SHADE)
    for number, fault in enumerate(judged.figures.faults):
        axes.axvline(fault.t, label=None if number else "fault", **_FAULT)
    # The axis reaches at least to 10 mm/s, so that rounding errors of arms at rest are not visible.
    axes.set_ylim(0.0, max(10.0, axes.get_ylim()[1]))


def _draw_errors(axes: Axes, judged: Judged) -> None:
    for index, arm in enumerate(judged.episode.arms):
        _draw(axes, arm, judged.episode.frame_t, 1e3 * tracking_errors(judged.episode, index)[0])
    # The axis is not extended to the limit. If the limit is far above all errors, they would look like a flat line.
    highest = max(1.0, axes.get_ylim()[1])
    if (limit := judged.settings.max_position_error_p99) is not None:
        axes.axhline(1e3 * limit, label=f"p99 at most {1e3 * limit:g}", **_LIMIT)
    axes.set_ylim(0.0, highest)


def _draw_hands(axes: Axes, judged: Judged) -> None:
    """Draw each time between two poses, at the time of the second pose, so that a long dropout is a high peak."""
    for name, hand in judged.episode.hands.items():
        received = np.unique(hand.received[np.isfinite(hand.received)])
        if len(received) > 1:
            t, gaps = thinned(received[1:], 1e3 * np.diff(received), np.fmax)
            axes.plot(t, gaps, color=_COLOURS[name], linestyle=_LINE_STYLES[name], linewidth=1.0, label=f"{name} hand")
    axes.axhline(1e3 * judged.settings.dropout, color="black", linestyle=":", linewidth=1.2, label="dropout")
    if judged.settings.max_pose_gap is not None:
        axes.axhline(1e3 * judged.settings.max_pose_gap, label="at most", **_LIMIT)
    axes.set_ylim(bottom=0.0)


def _draw_margin(axes: Axes, judged: Judged) -> None:
    ticks = judged.episode.ticks
    margin = np.where(np.isfinite(ticks.margin), 1e3 * ticks.margin, np.nan)
    axes.plot(*thinned(ticks.t, margin, np.fmin), color="#3b7d3b", label="tightest pair")
    axes.axhline(0.0, label="limit", **_LIMIT)
    axes.set_ylim(bottom=min(-2.0, float(np.nanmin(margin, initial=0.0))))


def _draw_leash(axes: Axes, judged: Judged) -> None:
    """Draw how far the leash dragged the target, and the ticks at which the controller did not follow the target."""
    ticks = judged.episode.ticks
    for index, arm in enumerate(judged.episode.arms):
        _draw(axes, arm, ticks.t, 1e3 * ticks.slip[:, index])
    highest = max(1.0, 1.1e3 * float(ticks.slip.max(initial=0.0)))
    for flags, label, colour, height in (
        (ticks.fallback, "stop executed", "#6a4c93", 0.06),
        (ticks.rejected.any(axis=1), "target rejected", "black", 0.12),
        (~ticks.certified, "no certified stop", "#b3202c", 0.18),
    ):
        if flags.any():
            t, some = thinned(ticks.t, np.where(flags, height * highest, np.nan), np.fmax)
            axes.plot(t, some, linestyle="none", marker="|", markersize=6, color=colour, label=label)
    axes.set_ylim(-0.03 * highest, highest)


def _draw_timing(axes: Axes, judged: Judged) -> None:
    """Draw the time between ticks, and a red background where ticks are missing in the file."""
    ticks = judged.episode.ticks
    axes.plot(*thinned(ticks.t, 1e3 * ticks.dt, np.fmax), color="#555555", linewidth=1.0, label="between ticks")
    if judged.episode.recording.about.realtime:  # Computing times do not matter in simulated time.
        compute = thinned(ticks.t, 1e3 * ticks.compute_time, np.fmax)
        axes.plot(*compute, color=_COLOURS["left"], linewidth=0.8, alpha=0.7, label="computing")
    for number, at in enumerate(np.flatnonzero(np.diff(ticks.number) > 1)[:_POINTS]):
        axes.axvspan(ticks.t[at], ticks.t[at + 1], label=None if number else "lost ticks", **_LOST)
    axes.set_ylim(bottom=0.0)


def _draw(axes: Axes, arm: str, t: Array, values: Array) -> None:
    style = {"color": _COLOURS[arm], "linestyle": _LINE_STYLES[arm], "linewidth": 1.4, "label": f"{arm} arm"}
    axes.plot(*thinned(t, values, np.fmax), **style)


_PLOTS = (
    (_draw_speed, "speed of the measured tools", "speed [mm/s]"),
    (_draw_errors, "tracking: measured tool from target, while engaged", "error [mm]"),
    (_draw_hands, "hands: time between two poses", "time [ms]"),
    (_draw_margin, "distance of monitored pairs beyond what they keep", "to spare [mm]"),
    (_draw_leash, "limits: how far the leash has dragged the targets", "slip [mm]"),
    (_draw_timing, "timing of the loop", "time [ms]"),
)

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
