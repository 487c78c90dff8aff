"""Write the cost of arms without a target, w |v - k (hold - q)|^2. It keeps their joints at the positions ``hold``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control.control.jit import kernel
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.control.targets import TaskTargets
    from q2r2_control.control.tasks.built_in import TaskData

# With this weight, the task of the other arm does not move an arm that holds. The arm moves only if a pair is too
# close.
_WEIGHT = 300.0
_GAIN = 4.0  # [1/s]


@kernel
def accumulate_hold_cost(data: TaskData, targets: TaskTargets, q: Array) -> None:
    """Add the cost of every arm that follows no target."""
    for i in range(targets.follows.shape[0]):
        if targets.follows[i] == 1:
            continue
        for j in range(q.shape[0]):
            if targets.member[i, j] == 1.0:
                data.H[j, j] += _WEIGHT
                data.g[j] -= _WEIGHT * _GAIN * (targets.hold[j] - q[j])
