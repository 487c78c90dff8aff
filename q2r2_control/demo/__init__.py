"""The tasks of ``q2r2 demo``, and the judges that decide whether the simulated arms did them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.demo.assembly_tasks import AssemblyTask as AssemblyTask
    from q2r2_control.demo.assembly_tasks import TaskResult as TaskResult
    from q2r2_control.demo.assembly_tasks import TaskWatch as TaskWatch
    from q2r2_control.demo.assembly_tasks import tasks_named as tasks_named

_MODULES = {
    "AssemblyTask": "assembly_tasks",
    "TaskResult": "assembly_tasks",
    "TaskWatch": "assembly_tasks",
    "tasks_named": "assembly_tasks",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
