"""What people see of a run or a headset. All of it listens; nothing waits for it, and none of it needs ROS.

``live`` is the table of a run, which ``drawing`` draws in a process of its own, ``history`` what ``report`` draws plots
from, ``topic_table`` and ``headset_table`` show what a headset sends; ``sound`` is for who looks elsewhere. A name is
imported when it is used: a table needs no control kernels and no plots.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.viewer.headset_table import HeadsetDisplay
    from q2r2_control.viewer.history import History
    from q2r2_control.viewer.live import LiveTable
    from q2r2_control.viewer.report import draw_report

__all__ = [
    "HeadsetDisplay",
    "History",
    "LiveTable",
    "draw_report",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "HeadsetDisplay": "headset_table",
        "History": "history",
        "LiveTable": "live",
        "draw_report": "report",
    },
)
