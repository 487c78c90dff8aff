"""The arrays that the compiled kernels of one controller write: the reference's state and scratch."""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.control.kernel_model import KernelModel
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.tasks.task_data import TaskData


class KernelData(NamedTuple):
    """What changes from tick to tick, by the rooms that write it."""

    safety: SafetyData
    tasks: TaskData

    @classmethod
    def empty(cls, model: KernelModel) -> KernelData:
        """Arrays of the sizes that ``model`` needs."""
        safety = SafetyData.empty(model.safety)
        return cls(safety, TaskData.empty(model.tasks, safety.collision.placements))
