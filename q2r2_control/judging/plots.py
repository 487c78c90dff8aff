"""The plots of one episode, as an SVG picture that does not grow with the episode."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from q2r2_control.judging.episode import stretches
from q2r2_control.judging.judge import Judged
from q2r2_control.judging.motion import tracking_errors
from q2r2_control.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes


COLOURS = {"left": "#1f6fb2", "right": "#d9722b"}
LINE_STYLES: dict[str, Any] = {"left": "-", "right": (0, (4, 3))}  # where both share a plot, the right lies on top
MARGIN_COLOUR = "#3b7d3b"
_LIMIT = "#b3202c"


def draw_limit(axes: Axes, value: float, label: str | None) -> None:
    """A line that the plot is to stay on one side of."""
    axes.axhline(value, color=_LIMIT, linestyle="--", linewidth=1.2, label=label)


_POINTS = 500  # of a line, at most
_SPEED_OVER = 5  # frames
_SHADE: dict[str, Any] = {"color": "#b0b0b0", "alpha": 0.35, "linewidth": 0.0}
_LOST: dict[str, Any] = {"color": "#b3202c", "alpha": 0.4, "linewidth": 0.0}
_FAULT: dict[str, Any] = {"color": "#6a4c93", "linestyle": "-.", "linewidth": 1.4}


def draw_episode(judged: Judged) -> str:
    """Speed, tracking, hands, distances, limits and timing over time, as the text of an SVG file."""
    # Imported here, since it takes longer than all else that a command without plots needs.
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
    """At most 500 points of a line: of pieces of equal length the ``extreme``, ``np.fmax`` or ``np.fmin``."""
    if len(t) <= _POINTS:
        return t, values
    starts = np.unique(np.linspace(0, len(t), _POINTS, endpoint=False).astype(int))
    return t[starts], extreme.reduceat(values, starts)


def _draw_speed(axes: Axes, judged: Judged) -> None:
    """Measured tools, and while no arm is engaged a grey ground."""
    episode = judged.episode
    t = episode.frame_t
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
    axes.set_ylim(0.0, max(10.0, axes.get_ylim()[1]))  # of arms at rest not the rounding


def _draw_errors(axes: Axes, judged: Judged) -> None:
    for index, arm in enumerate(judged.episode.arms):
        _draw(axes, arm, judged.episode.frame_t, 1e3 * tracking_errors(judged.episode, index)[0])
    limit = judged.settings.max_position_error_p99
    if limit is not None:
        draw_limit(axes, 1e3 * limit, "p99 at most")
    axes.set_ylim(bottom=0.0)


def _draw_hands(axes: Axes, judged: Judged) -> None:
    """Each time between two poses at its end, so that a dropout is as high as it is long."""
    for name, hand in judged.episode.hands.items():
        received = np.unique(hand.received[np.isfinite(hand.received)])
        if len(received) > 1:
            t, gaps = thinned(received[1:], 1e3 * np.diff(received), np.fmax)
            axes.plot(t, gaps, color=COLOURS[name], linestyle=LINE_STYLES[name], linewidth=1.0, label=f"{name} hand")
    axes.axhline(1e3 * judged.settings.dropout, color="black", linestyle=":", linewidth=1.2, label="dropout")
    if judged.settings.max_pose_gap is not None:
        draw_limit(axes, 1e3 * judged.settings.max_pose_gap, "at most")
    axes.set_ylim(bottom=0.0)


def _draw_margin(axes: Axes, judged: Judged) -> None:
    ticks = judged.episode.ticks
    margin = np.where(np.isfinite(ticks.margin), 1e3 * ticks.margin, np.nan)
    axes.plot(*thinned(ticks.t, margin, np.fmin), color=MARGIN_COLOUR, label="tightest pair")
    draw_limit(axes, 0.0, "limit")
    axes.set_ylim(bottom=min(-2.0, float(np.nanmin(margin, initial=0.0))))


def _draw_leash(axes: Axes, judged: Judged) -> None:
    """What the leash dragged, and the ticks at which the controller did not do as it was asked."""
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
    """Time between ticks, and where some are not in the file a red ground."""
    ticks = judged.episode.ticks
    axes.plot(*thinned(ticks.t, 1e3 * ticks.dt, np.fmax), color="#555555", linewidth=1.0, label="between ticks")
    if judged.episode.recording.about.realtime:  # in simulated time it is nobody's matter
        compute = thinned(ticks.t, 1e3 * ticks.compute_time, np.fmax)
        axes.plot(*compute, color=COLOURS["left"], linewidth=0.8, alpha=0.7, label="computing")
    for number, at in enumerate(np.flatnonzero(np.diff(ticks.number) > 1)[:_POINTS]):
        axes.axvspan(ticks.t[at], ticks.t[at + 1], label=None if number else "lost ticks", **_LOST)
    axes.set_ylim(bottom=0.0)


def _draw(axes: Axes, arm: str, t: Array, values: Array) -> None:
    style = {"color": COLOURS[arm], "linestyle": LINE_STYLES[arm], "linewidth": 1.4, "label": f"{arm} arm"}
    axes.plot(*thinned(t, values, np.fmax), **style)


_PLOTS = (
    (_draw_speed, "speed of the measured tools", "speed [mm/s]"),
    (_draw_errors, "tracking: measured tool from target, while engaged", "error [mm]"),
    (_draw_hands, "hands: time between two poses", "time [ms]"),
    (_draw_margin, "distance of monitored pairs beyond what they keep", "to spare [mm]"),
    (_draw_leash, "limits: how far the leash has dragged the targets", "slip [mm]"),
    (_draw_timing, "timing of the loop", "time [ms]"),
)
