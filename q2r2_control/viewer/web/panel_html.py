"""The HTML of the panel's numbers, words and plots."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

STYLE = "font-size:12px;line-height:1.35;padding:0 0.6em 0.4em"
_GONE = 2.0  # A hand without poses for longer than this is not shown any more [s].
HISTORY = 150  # Number of values in a plot.


def coloured(text: str, colour: tuple[int, int, int]) -> str:
    return f"<b style='color:rgb{colour}'>{escape(text)}</b>"


def distance(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm" if np.isfinite(metres) else "-"


def milliseconds(age: float | None) -> str:
    """Return the ``age`` [s] of a hand's newest pose in milliseconds; empty if there is no hand any more."""
    return "" if age is None or age > _GONE else f"{1e3 * age:.0f} ms"


def table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in rows)
    return f"<div style='{STYLE}'><table>{cells}</table></div>"


def image(name: str, picture: bytes) -> str:
    data = f"data:image/jpeg;base64,{b64encode(picture).decode()}"
    return f"<div style='{STYLE}'>{escape(name)}<img src='{data}' style='display:block;width:100%'></div>"


def share(opening: float | None) -> str:
    return "-" if opening is None else f"{100.0 * opening:.0f} % open"


def plot(label: str, values: Sequence[float], top: float) -> str:
    """Return the HTML of a plot of ``values`` as a line. The vertical axis goes from 0 to ``top``."""
    points = " ".join(f"{100.0 * i / HISTORY:.0f},{20.0 * (1.0 - min(y / top, 1.0)):.1f}" for i, y in enumerate(values))
    return (
        f"<div style='color:#777'>{label}</div><svg viewBox='0 0 100 21' preserveAspectRatio='none'"
        " style='display:block;width:100%;height:24px;background:#8881'><polyline fill='none' stroke='#3c78d8'"
        f" vector-effect='non-scaling-stroke' points='{points}'/></svg>"
    )
