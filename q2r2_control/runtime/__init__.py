"""What a control loop needs besides its data: time, signals, garbage collection, and the figures of a run.

``loop_clock`` says when a tick is due, ``process`` stops on signals without interrupting a tick, ``run_summary`` and
``torque_summary`` gather a run's figures tick by tick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.runtime.loop_clock import LoopClock
    from q2r2_control.runtime.process import few_garbage_collections, stop_on_signals
    from q2r2_control.runtime.run_summary import RunStatistics, RunSummary
    from q2r2_control.runtime.torque_summary import TorqueStatistics, TorqueSummary

__all__ = [
    "LoopClock",
    "RunStatistics",
    "RunSummary",
    "TorqueStatistics",
    "TorqueSummary",
    "few_garbage_collections",
    "stop_on_signals",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "LoopClock": "loop_clock",
        "RunStatistics": "run_summary",
        "RunSummary": "run_summary",
        "TorqueStatistics": "torque_summary",
        "TorqueSummary": "torque_summary",
        "few_garbage_collections": "process",
        "stop_on_signals": "process",
    },
)
