"""What a control loop needs besides its data: time, signals, garbage collection, and the figures of a run.

``loop_clock`` says when a tick is due, ``process`` stops on signals without interrupting a tick, ``scheduling`` asks
the system for punctuality, ``plant_clock`` tells how old a state is. ``operator_side`` has all that is the operator's,
``arm_conditions`` what hands feel of arms, and ``body_changes`` fingers and held objects. ``recorder`` gives each
``Tick`` to listeners and its figures to ``run_summary``, which gathers them with ``joint_extremes``, ``histogram`` and
``torque_summary``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.runtime.loop_clock import LoopClock
    from q2r2_control.runtime.process import few_garbage_collections, stop_on_signals
    from q2r2_control.runtime.recorder import RunRecorder, RunStart, Tick
    from q2r2_control.runtime.run_summary import RunStatistics, RunSummary
    from q2r2_control.runtime.scheduling import real_time
    from q2r2_control.runtime.torque_summary import TorqueStatistics, TorqueSummary

__all__ = [
    "LoopClock",
    "RunRecorder",
    "RunStart",
    "RunStatistics",
    "RunSummary",
    "Tick",
    "TorqueStatistics",
    "TorqueSummary",
    "few_garbage_collections",
    "real_time",
    "stop_on_signals",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "LoopClock": "loop_clock",
        "RunRecorder": "recorder",
        "RunStart": "recorder",
        "RunStatistics": "run_summary",
        "RunSummary": "run_summary",
        "Tick": "recorder",
        "TorqueStatistics": "torque_summary",
        "TorqueSummary": "torque_summary",
        "few_garbage_collections": "process",
        "real_time": "scheduling",
        "stop_on_signals": "process",
    },
)
