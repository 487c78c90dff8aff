"""Tasks of the user's program and of other packages: costs on the next joint velocities, written in NumPy.

A program passes its tasks to the controller as objects. A package names its task as an entry point of the group
``q2r2_control.tasks``. A cell's YAML lists the task, with its settings, under ``control.tasks``. The costs are added to
the costs of the built-in tasks before the QP is solved. Limits, separation and the certificate do not depend on costs,
so no task can break them.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from q2r2_control.control.answers import Answer, answer_of
from q2r2_control.errors import ConfigError, shown
from q2r2_control.plugins import points_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

GROUP = "q2r2_control.tasks"
_ROUNDING = 1e-9  # Allowed error of a matrix by rounding, as a share of its greatest entry.


class Task(Protocol):
    """A cost on the next joint velocities: any object with this method.

    ``CartesianController(robot, settings, tasks=[MyTask()])`` adds it to the tasks of the tools. A task that a YAML
    names is made as ``make(robot, **settings)``.
    """

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the cost 1/2 v+' H v+ + g' v+ of the next joint velocities v+.

        A task that wants J v+ = u with a weight w returns H = w J'J and g = -w J'u. The error of a tool has the weight
        1 for metres and 0.09 for radians, and the posture has 1e-3. The method is called at every substep and by
        :meth:`CartesianController.problem`. Its answer must therefore depend on q and v alone. A call should take less
        than 20 us.

        Args:
            q: Joint positions of the reference (nv,) [rad].
            v: Joint velocities of the reference (nv,) [rad/s].

        Returns:
            H (nv, nv), symmetric and positive semidefinite, and g (nv,). The controller's constructor raises
            ConfigError if the answer at home is anything else. Later, such an answer or an exception is not used, and
            the step's report says so in ``faults``.
        """


def load_tasks(robot: Robot, wanted: Mapping[str, Mapping[str, Any]]) -> dict[str, Task]:
    """Return the tasks that the settings ``wanted`` name, by their key in the settings.

    Raises :class:`ConfigError` if a task is unknown, or if its settings are not allowed.
    """
    if not wanted:
        return {}
    installed = points_of(GROUP)
    tasks: dict[str, Task] = {}
    for name, settings in wanted.items():
        if name not in installed:
            raise ConfigError(f"control.tasks.{name}: installed tasks: {', '.join(installed) or 'none'}")
        made = installed[name].load()
        try:
            tasks[f"control.tasks.{name}"] = made(robot, **settings)
        except (TypeError, ValueError, ConfigError) as error:
            raise ConfigError(f"control.tasks.{name}{_fault(made, settings, error)}") from error
    return tasks


def _fault(made: Any, settings: Mapping[str, Any], error: Exception) -> str:
    """Return a text about the first unknown or missing setting, or else about the ``error`` that the task raised."""
    parameters = list(inspect.signature(made).parameters.values())[1:]
    known = [one.name for one in parameters if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)]
    allowed = f"; its settings: {', '.join(known) or 'none'}"
    for key, value in settings.items():
        if key not in known and len(known) == len(parameters):
            return f".{key} = {shown(value)}: no such setting{allowed}"
    for one in parameters:
        if one.name in known and one.default is one.empty and one.name not in settings:
            return f".{one.name} is missing{allowed}"
    return f": {error}{allowed}"


class ExternalTasks:
    """The tasks of one controller whose costs are computed at every substep. The tasks of its settings come first."""

    def __init__(self, robot: Robot, settings: Mapping[str, Mapping[str, Any]], own: Sequence[Task]) -> None:
        """Raise :class:`ConfigError` if an object is not a task, or if its cost at home is not usable."""
        if not isinstance(own, list | tuple):
            raise ConfigError(f"tasks = {shown(own)}: allowed: a list of objects with a method cost(q, v)")
        self._tasks = load_tasks(robot, settings)
        for i, task in enumerate(own):
            key = f"tasks[{i}]"
            if isinstance(task, type) or not callable(getattr(task, "cost", None)):
                raise ConfigError(f"{key} = {shown(task)}: allowed: an object with a method cost(q, v)")
            cost = _cost_of(task, np.array(robot.home), np.zeros(robot.model.nv))
            if isinstance(cost, str):
                raise ConfigError(f"{key}: {type(task).__name__}.cost {cost}")
            self._tasks[f"{key} {type(task).__name__}"] = task

    def __bool__(self) -> bool:
        return bool(self._tasks)

    def add_costs(self, H: Array, g: Array, q: Array, v: Array) -> tuple[str, ...]:
        """Add the cost of each task at ``q`` and ``v`` to H (nv, nv) and g (nv,).

        Return a reason for each cost that was not used.
        """
        faults = []
        for key, task in self._tasks.items():
            cost = _cost_of(task, q, v)
            if isinstance(cost, str):
                faults.append(f"{key}: cost {cost}")
            else:
                H += cost[0]
                g += cost[1]
        return tuple(faults)


def _cost_of(task: Task, q: Array, v: Array) -> Answer | str:
    nv = len(q)
    cost = answer_of(task.cost, q, v, f"{(nv, nv)} and {(nv,)}")
    if isinstance(cost, str):
        return cost
    H, g = cost
    if len(g) != nv:
        return f"returned shapes {H.shape} and {g.shape}; allowed: {(nv, nv)} and {(nv,)}"
    rounding = _ROUNDING * (1.0 + float(np.abs(H).max()))
    try:
        np.linalg.cholesky(H + rounding * np.eye(nv))
    except np.linalg.LinAlgError:
        return "returned a matrix that is not positive semidefinite"
    if np.abs(H - H.T).max() > rounding:
        return "returned a matrix that is not symmetric"
    return cost
