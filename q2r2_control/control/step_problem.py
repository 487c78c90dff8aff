"""Write the QP of each step of one controller, with the user's own tasks and constraints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.constraints import Constraint, OwnConstraints
from q2r2_control.control.jit import bound
from q2r2_control.control.kernel_model import KernelData
from q2r2_control.control.kernel_pointers import KernelPointer
from q2r2_control.control.qp import QpProblem, QpSolution, assemble, find_minimum
from q2r2_control.control.step_report import StepSummary
from q2r2_control.control.tasks.external import ExternalTasks, Task
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class StepProblem:
    """Writes the QP of a step, its ``problem``, from the kernels' model, targets and data."""

    def __init__(
        self, robot: Robot, settings: ControllerSettings, tasks: Sequence[Task], constraints: Sequence[Constraint]
    ) -> None:
        """Raise :class:`ConfigError` if one of the tasks or constraints is not usable at home."""
        self._longest = settings.max_substep
        self._external = ExternalTasks(robot, settings.tasks, tasks)
        self.constraints = OwnConstraints(robot, constraints)

    def connect(self, model: KernelPointer, targets: KernelPointer, data: KernelPointer) -> None:
        """Compile the kernels for these pointers. Before that, a reset has to write the values behind the pointers."""
        self._pointers = model, targets, data
        arrays: KernelData = data.value
        self._rows, self._tasks, self._state = arrays.safety.rows, arrays.tasks, arrays.safety.state
        self.problem = QpProblem(
            H=arrays.tasks.H,
            g=arrays.tasks.g,
            lower=arrays.safety.box.lower,
            upper=arrays.safety.box.upper,
            rows=arrays.safety.rows.matrix[:0],
            rows_lower=arrays.safety.rows.lower[:0],
        )
        self._assemble = bound(assemble, *self._pointers, self._longest, -1.0)
        if self._external:
            self._find_minimum = bound(find_minimum, data)

    def take_targets(self, summary: StepSummary) -> None:
        """Make the offered poses the targets, in a tick in which the reference does not move."""
        summary.targets_usable, _, _ = self._assemble(*self._pointers, self._longest, 0.0)

    def write(self, h: float, tick: float, summary: StepSummary) -> None:
        """Write the problem of a step of ``h`` [s]. See :func:`assemble` for ``tick``."""
        usable, inside, free = self._assemble(*self._pointers, h, tick)
        summary.targets_usable &= usable
        summary.inside &= inside
        tasks, state, rows, problem = self._tasks, self._state, self._rows, self.problem
        if self._external:
            summary.faults += self._external.add_costs(tasks.H, tasks.g, state.q, state.v)
            free = self._find_minimum(self._pointers[-1])
        count = int(rows.used[0])
        problem.rows, problem.rows_lower = rows.matrix[:count], rows.lower[:count]
        if self.constraints:
            own = self.constraints
            summary.faults += own.write(state.q, state.v)
            problem.rows = np.concatenate([problem.rows, own.matrix])
            problem.rows_lower = np.concatenate([problem.rows_lower, own.lower])
            problem.hard = own.hard
            free = free and own.allow(tasks.minimum)
        problem.minimum = tasks.minimum if free else None


class GivenSolution:
    """A solver that always gives the same answer, which the user's program has found."""

    def __init__(self, x: object, nv: int) -> None:
        """Take the answer ``x``. Its first nv numbers are the velocities [rad/s]. Any other ``x`` is no solution."""
        self._v: Array | None = None
        try:
            given = np.asarray(x)
            numbers = np.array(given, dtype=np.float64) if given.dtype.kind != "c" else np.zeros(0)
        except Exception:  # ``x`` may be any object, which may raise any exception.
            return
        if numbers.ndim == 1 and len(numbers) >= nv and np.isfinite(numbers[:nv]).all():
            self._v = numbers[:nv]

    def solve(self, problem: QpProblem) -> QpSolution:
        """Return the given answer for any problem."""
        return QpSolution(self._v, 0.0)
