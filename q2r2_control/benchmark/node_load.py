"""What a set of nodes takes of the processors, and how evenly its joint commands move. Imports no ROS."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from q2r2_control.types import Array

# Motion that is slower than this is the hand's own, and what is faster is ripple [s].
_TREND = 0.15


@dataclass(frozen=True, slots=True)
class NodeLoad:
    """Processor time of one node, in percent of one core."""

    node: str
    idle: float  # all are up and no arm is engaged
    moving: float  # both arms follow circles


@dataclass(frozen=True, slots=True)
class LoadReport:
    """What ``q2r2 bench --ros`` measured of the whole set."""

    seconds: float  # of each of both
    jitter: float  # each sample of the hands comes later by up to this, at random [s]
    rows: tuple[NodeLoad, ...]
    commands_hz: float
    speed_ripple: float  # RMS of the joints' commanded speed about its trend, as a share of its RMS, to a robot

    @property
    def total(self) -> NodeLoad:
        """All nodes together."""
        return NodeLoad("all", sum(row.idle for row in self.rows), sum(row.moving for row in self.rows))

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"total": asdict(self.total)}


def times_of_a_robot(times: Array) -> Array:
    """When a robot follows commands that were sent at ``times`` (n,) [s]: one of its own periods after the other.

    It takes the newest command once a period, so a command that is a little early or late makes no difference. Where
    one is missing it waits for two.
    """
    gaps = np.diff(times)
    period = float(np.median(gaps))
    periods = np.maximum(np.round(gaps / period), 1.0)
    return np.concatenate([[0.0], period * np.cumsum(periods)])


def speed_ripple(times: Array, q: Array) -> float:
    """RMS of the speeds between joint positions about their trend, as a share of the trend's RMS.

    ``times`` (n,) [s], ascending; ``q`` (n, nv) [rad]. The trend is a mean over 0.15 s, weighted by a Hann window.
    """
    dt = np.diff(times)
    v = np.diff(q, axis=0) / dt[:, None]
    window = np.hanning(2 * max(round(_TREND / float(np.median(dt)) / 2.0), 1) + 1)
    trend = np.apply_along_axis(lambda column: np.convolve(column, window / window.sum(), "valid"), 0, v)
    margin = len(window) // 2
    ripple = v[margin : len(v) - margin] - trend
    return float(np.sqrt((ripple**2).sum() / (trend**2).sum()))
