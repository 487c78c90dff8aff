"""The PNG of a run: tracking, distances and limits over time."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.types import Array
from q2r2_control.viewer.history import History
from q2r2_control.viewer.plot_style import COLOURS, LINE_STYLES, MARGIN_COLOUR, draw_limit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXES_STYLE = (("x", 1.0), ("y", 0.7), ("z", 0.45))  # name, opacity
_TARGET_STYLE: dict[str, Any] = {"color": "black", "linestyle": (0, (2, 4)), "linewidth": 1.0}
_CLOSED = 0.95  # a gripper's opening below which it is drawn as closed
_LABEL_ROOM = 0.09  # between two labels beside the joints' plot, in its units


def draw_report(history: History, summary: RunSummary, title: str, file: Path) -> None:
    """Write the plots of ``history`` to ``file``."""
    # Imported here, since it takes longer than all else that a command without a report needs.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 15.0), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(f"{title}\n{_headline(summary)}", fontsize=13)
    arms = list(history.robot.arms)
    grid = figure.subplots(4, 2, sharex=True, squeeze=False)
    for column, arm in enumerate(arms):
        _draw_path(grid[0, column], history, arm)
        _draw_joints(grid[3, column], history, arm)
    # One scale for both arms; sharing the axis would keep the first one's limits.
    limits = [axes.get_ylim() for axes in grid[0, : len(arms)]]
    for axes in grid[0, : len(arms)]:
        axes.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
    _draw_errors(grid[1, 0], history, arms, "position")
    _draw_errors(grid[1, 1], history, arms, "rotation")
    _draw_margin(grid[2, 0], history)
    _draw_ratios(grid[2, 1], history)
    for axes in grid.flat:
        axes.grid(alpha=0.3)
        axes.margins(x=0.01)
    for axes in grid[3]:
        axes.set_xlabel("time [s]")
    for unused in range(len(arms), 2):
        for row in (0, 3):
            grid[row, unused].set_axis_off()
    canvas.print_png(file)


def _headline(summary: RunSummary) -> str:
    parts = [f"{summary.duration_s:.1f} s at {summary.loop_rate_hz:.0f} Hz"]
    for name, arm in summary.arms.items():
        if arm.position_error_mm_rms is not None and arm.rotation_error_deg_rms is not None:
            parts.append(f"{name} {arm.position_error_mm_rms:.2f} mm, {arm.rotation_error_deg_rms:.2f} deg RMS")
    if summary.min_distance_mm is not None:
        parts.append(f"never nearer than {summary.min_distance_mm:.1f} mm")
    return "   |   ".join(parts)


def _draw_path(axes: Axes, history: History, arm: str) -> None:
    """Displacement from where the tool started, and while the gripper is closed."""
    colour, rows = COLOURS[arm], history.rows[arm]
    start, t = rows["tool"][:1], history.rows["t"]
    measured, target = 1e3 * (rows["tool"] - start), 1e3 * (rows["target"] - start)
    for index, (name, opacity) in enumerate(_AXES_STYLE):
        axes.plot(t, measured[:, index], color=colour, alpha=opacity, linewidth=2.0, label=f"{name} measured")
        axes.plot(t, target[:, index], **_TARGET_STYLE)
    for index, (name, _) in enumerate(_AXES_STYLE):
        farthest = int(np.abs(measured[:, index]).argmax())
        axes.annotate(
            name,
            (t[farthest], measured[farthest, index]),
            xytext=(0, 4),
            textcoords="offset points",
            ha="center",
            fontsize=11,
            fontweight="bold",
            color=colour,
        )
    axes.plot([], [], **_TARGET_STYLE, label="target")
    axes.set_title(f"{arm} tool: way from its start")
    axes.set_ylabel("displacement [mm]")
    axes.margins(y=0.12)
    closed = rows["gripper"] < _CLOSED
    if closed.any():
        band = axes.get_xaxis_transform()
        axes.fill_between(t, 0, 1, where=closed, transform=band, color="grey", alpha=0.12, lw=0, label="gripper closed")
    axes.legend(loc="best", fontsize=8, ncols=2)


def _draw_errors(axes: Axes, history: History, arms: list[str], kind: str) -> None:
    """Measured tool against the target, where engaged."""
    for arm in arms:
        rows = history.rows[arm]
        error = 1e3 * rows["position_error"] if kind == "position" else np.degrees(rows["rotation_error"])
        axes.plot(history.rows["t"], error, color=COLOURS[arm], linestyle=LINE_STYLES[arm], label=arm)
    axes.set_title(f"{kind} error of the measured tool, while engaged")
    axes.set_ylabel("error [mm]" if kind == "position" else "error [deg]")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="best", fontsize=8)


def _draw_margin(axes: Axes, history: History) -> None:
    rows = history.rows
    margin = np.where(np.isfinite(rows["margin"]), 1e3 * rows["margin"], np.nan)
    lowest = float(np.nanmin(margin, initial=0.0))
    axes.plot(rows["t"], margin, color=MARGIN_COLOUR, label="tightest monitored pair")
    draw_limit(axes, 0.0, "limit")
    axes.set_title("distance of monitored pairs beyond what they keep")
    axes.set_ylabel("distance to spare [mm]")
    axes.set_ylim(bottom=min(-2.0, lowest))
    axes.legend(loc="best", fontsize=8)


def _draw_ratios(axes: Axes, history: History) -> None:
    rows = history.rows
    axes.plot(rows["t"], rows["velocity_ratio"], color="#6a4c93", label="velocity, worst joint")
    axes.plot(rows["t"], rows["acceleration_ratio"], color="#8d8d8d", linewidth=1.0, label="acceleration, worst joint")
    draw_limit(axes, 1.0, "limit")
    axes.set_title("reference velocity and acceleration, as part of their limits")
    axes.set_ylabel("ratio [1]")
    axes.set_ylim(0.0, 1.1)
    axes.legend(loc="best", fontsize=8)


def _draw_joints(axes: Axes, history: History, arm: str) -> None:
    robot = history.robot
    joints = robot.arms[arm].joints
    lower, upper = robot.position_lower[joints], robot.position_upper[joints]
    place: Array = (2.0 * history.rows["q"][:, joints] - lower - upper) / (upper - lower)
    for number in range(len(joints)):
        opacity = 1.0 - 0.75 * number / max(len(joints) - 1, 1)
        axes.plot(history.rows["t"], place[:, number], color=COLOURS[arm], alpha=opacity)
    for number, height in enumerate(_spread(place[-1])):
        name = robot.joint_names[joints[number]].removeprefix(f"{arm}_")
        axes.annotate(
            name, (1.01, height), xycoords=("axes fraction", "data"), va="center", fontsize=8, color=COLOURS[arm]
        )
    draw_limit(axes, 1.0, "limits")
    draw_limit(axes, -1.0, None)
    axes.set_title(f"{arm} joints between their limits")
    axes.set_ylabel("position: -1 lower, +1 upper limit")
    axes.set_ylim(-1.1, 1.1)


def _spread(heights: Array) -> Array:
    """Heights of labels, moved up where one would cover the one below."""
    spread = np.array(heights)
    order = np.argsort(heights)
    for below, above in itertools.pairwise(order):
        spread[above] = max(spread[above], spread[below] + _LABEL_ROOM)
    return spread
