"""Start, schedule and end processes: the process that runs a loop, and the processes beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.process.answering_process import AnsweringProcess as AnsweringProcess
    from q2r2_control.process.helper_process import leave_signals_to_the_run as leave_signals_to_the_run
    from q2r2_control.process.helper_process import reason_of as reason_of
    from q2r2_control.process.helper_process import start_python as start_python
    from q2r2_control.process.scheduling import few_garbage_collections as few_garbage_collections
    from q2r2_control.process.scheduling import how_it_ended as how_it_ended
    from q2r2_control.process.scheduling import real_time as real_time
    from q2r2_control.process.scheduling import reserve as reserve
    from q2r2_control.process.scheduling import thread_priority as thread_priority

_MODULES = {
    "AnsweringProcess": "answering_process",
    "few_garbage_collections": "scheduling",
    "how_it_ended": "scheduling",
    "leave_signals_to_the_run": "helper_process",
    "real_time": "scheduling",
    "reason_of": "helper_process",
    "reserve": "scheduling",
    "start_python": "helper_process",
    "thread_priority": "scheduling",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
