"""Colours and lines that all plots share; the two arms' are told apart by those who see no red or no green too."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"left": "#1f6fb2", "right": "#d9722b"}
LINE_STYLES: dict[str, Any] = {"left": "-", "right": (0, (4, 3))}  # where both share a plot, the right lies on top
MARGIN_COLOUR = "#3b7d3b"
_LIMIT = "#b3202c"


def draw_limit(axes: Axes, value: float, label: str | None) -> None:
    """A line that the plot is to stay on one side of."""
    axes.axhline(value, color=_LIMIT, linestyle="--", linewidth=1.2, label=label)
