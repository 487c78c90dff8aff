"""Tasks of other packages: costs on the next joint velocities, written in NumPy and found by their name.

A package names its task as an entry point of the group ``q2r2_control.tasks``; a cell's YAML asks for it, with its
settings, under ``control.tasks``. Its cost is added to those of the built-in tasks before the QP is solved. Limits,
separation and the certificate do not depend on costs, so no task can break them.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any, Protocol

import numpy as np

from q2r2_control.errors import ConfigError, shown
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

GROUP = "q2r2_control.tasks"


class Task(Protocol):
    """Made of the robot and the task's settings: ``make(robot, **settings)``."""

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """H (nv, nv), symmetric and positive semidefinite, and g (nv,) of the cost 1/2 v+' H v+ + g' v+.

        ``v+`` are the next joint velocities, ``q`` [rad] and ``v`` [rad/s] the reference's posture and velocities now,
        (nv,) each. The weight of a tool's error is 1 [s^2/m^2], that of the posture 1e-3. Called at every substep: keep
        it under 20 us. A cost with a number that is not finite is not used.
        """


def load_tasks(robot: Robot, wanted: Mapping[str, Mapping[str, Any]]) -> tuple[Task, ...]:
    """The tasks that the settings ask for. Raises :class:`ConfigError` for an unknown one and for bad settings."""
    if not wanted:
        return ()
    installed = {entry.name: entry for entry in entry_points(group=GROUP)}
    tasks: list[Task] = []
    for name, settings in wanted.items():
        if name not in installed:
            raise ConfigError(f"control.tasks.{name}: installed tasks: {', '.join(sorted(installed)) or 'none'}")
        made = installed[name].load()
        try:
            tasks.append(made(robot, **settings))
        except (TypeError, ValueError) as error:
            raise ConfigError(f"control.tasks.{name}{_fault(made, settings, error)}") from error
    return tuple(tasks)


def _fault(made: Any, settings: Mapping[str, Any], error: Exception) -> str:
    """The first setting that is unknown or missing; else what the task itself says."""
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


def add_costs(tasks: Sequence[Task], H: Array, g: Array, q: Array, v: Array) -> None:
    """Add to the cost H (nv, nv), g (nv,) that of each task at ``q`` and ``v``, unless it is not finite."""
    for task in tasks:
        own_H, own_g = task.cost(q.copy(), v.copy())
        if np.isfinite(own_H).all() and np.isfinite(own_g).all():
            H += own_H
            g += own_g
