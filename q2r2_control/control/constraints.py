"""A user's own linear constraints on the next joint velocities: rows of the QP in addition to the separation rows.

A soft constraint has a slack, as the separation rows have. A hard constraint has no slack, and is checked again
before a step is taken: if the velocities break it, the certified stop is executed instead. The certificate does not
read the users' rows. For that reason, no constraint can make the arms break a limit or a distance. For the same reason,
it is not proven that the certified stop satisfies a constraint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from q2r2_control.control.answers import Answer, answer_of
from q2r2_control.errors import ConfigError, shown
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ActiveLimit, Array, LimitKind

HARD_TOLERANCE = 1e-4  # Permitted violation of a hard row of unit norm, because solvers have a tolerance [rad/s].
_ACTIVE = 1e-7  # A row of unit norm that is this near to its bound counts as active [rad/s].
_TINY = 1e-9  # If the norm of a row is smaller than this, the row counts as depending on no joint.


class Constraint(Protocol):
    """A linear constraint on the next joint velocities: any object with this method.

    ``CartesianController(robot, settings, constraints=[MyConstraint()])`` adds it. It is soft, unless the object has an
    attribute ``hard`` that is True.

    **A hard constraint** is satisfied by every step except the certified stop. For rows of unit norm, A v+ is at least
    lower - 1e-4 rad/s, with the A and lower that ``rows`` returns at the start of the step. If the solver finds no such
    velocities, or if they cannot be certified, or if ``rows`` has no usable answer, the certified stop is executed
    instead. The stop was chosen earlier, without regard to the constraint, so the arms may break the constraint until
    they rest. A stop from full speed takes 0.3 s in the shipped cells. At rest the constraint holds if no ``lower`` is
    above 0.

    The constraint is about velocities and not about positions. How well the arms stay on one side of a plane depends on
    how well ``rows`` turns distances into velocities, and the stop may lead beyond the plane. Arms that can never
    satisfy the constraint stay where they are.
    """

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the rows A v+ >= lower that the next joint velocities v+ have to satisfy.

        An equality is two rows, one of them the negative of the other. To keep a distance d(q) above 0, return
        J_d v+ >= -gain d with the gradient J_d and a gain of about 5 /s. The method is called at every substep, and
        also by :meth:`CartesianController.problem`. Its answer must therefore depend on nothing but q and v.

        Args:
            q: Joint positions of the reference (nv,) [rad].
            v: Joint velocities of the reference (nv,) [rad/s].

        Returns:
            A (k, nv) and lower (k,), finite, with any k and rows of any norm. An exception or another answer is
            reported in ``faults`` of the step's report. If the constraint is soft, it then has no effect. If it is
            hard, the arms brake.
        """


class OwnConstraints:
    """The user's own constraints in one controller, and their rows at the present step."""

    def __init__(self, robot: Robot, own: Sequence[Constraint]) -> None:
        """Raise :class:`ConfigError` if an object is not a constraint, or has no usable rows at home."""
        allowed = "an object with a method rows(q, v), and hard = True or False if it has that"
        if not isinstance(own, list | tuple):
            raise ConfigError(f"constraints = {shown(own)}: allowed: a list of objects with a method rows(q, v)")
        self._soft: list[tuple[str, Constraint]] = []
        self._hard: list[tuple[str, Constraint]] = []
        for i, one in enumerate(own):
            key, hard, name = f"constraints[{i}]", getattr(one, "hard", False), type(one).__name__
            if isinstance(one, type) or not callable(getattr(one, "rows", None)) or not isinstance(hard, bool):
                raise ConfigError(f"{key} = {shown(one)}: allowed: {allowed}")
            rows = _unit_rows(one, np.array(robot.home), np.zeros(robot.model.nv))
            if isinstance(rows, str):
                raise ConfigError(f"{key}: {name}.rows {rows}")
            (self._hard if hard else self._soft).append((f"{key} {name}", one))
        nv = robot.model.nv
        # Left-hand sides of the rows (k, nv), of unit norm, and their lower bounds (k,) [rad/s].
        self.matrix, self.lower = np.zeros((0, nv)), np.zeros(0)
        self.hard = 0  # Number of hard rows, which come last.
        self._names: list[str] = []  # For each row, the key and the class name of its constraint.
        self._unknown = False  # Whether a hard constraint has no usable answer.

    def __bool__(self) -> bool:
        return bool(self._soft or self._hard)

    def write(self, q: Array, v: Array) -> tuple[str, ...]:
        """Compute the rows of every constraint at ``q`` and ``v``; return a line for each answer that is not used."""
        faults: list[str] = []
        found = [self._rows_of(kind, q, v, faults) for kind in (self._soft, self._hard)]
        rows = [answer for kind in found for _, answer in kind]
        self.matrix = np.concatenate([matrix for matrix, _ in rows] or [np.zeros((0, len(q)))])
        self.lower = np.concatenate([lower for _, lower in rows] or [np.zeros(0)])
        self._names = [name for kind in found for name, (_, lower) in kind for _ in lower]
        self.hard = sum(len(lower) for _, (_, lower) in found[1])
        self._unknown = len(found[1]) < len(self._hard)
        return tuple(faults)

    @staticmethod
    def _rows_of(kind: list[tuple[str, Constraint]], q: Array, v: Array, faults: list[str]) -> list[tuple[str, Answer]]:
        answers = []
        for key, one in kind:
            rows = _unit_rows(one, q, v)
            if isinstance(rows, str):
                faults.append(f"{key}: rows {rows}")
            else:
                answers.append((key, rows))
        return answers

    def allow(self, v: Array) -> bool:
        """Return whether ``v`` (nv,) [rad/s] satisfies all rows, soft and hard."""
        return not self._unknown and bool((self.matrix @ v >= self.lower).all())

    def permit(self, v: Array) -> bool:
        """Return whether ``v`` (nv,) [rad/s] may be executed: all hard rows are known, and ``v`` satisfies them."""
        first = len(self.lower) - self.hard
        return not self._unknown and bool((self.matrix[first:] @ v >= self.lower[first:] - HARD_TOLERANCE).all())

    def active(self, v: Array) -> tuple[tuple[ActiveLimit, ...], float]:
        """Return the constraints that are active or broken at ``v`` (nv,), and the largest violation [rad/s]."""
        slack = self.lower - self.matrix @ v
        names = dict.fromkeys(name for name, lacks in zip(self._names, slack, strict=True) if lacks >= -_ACTIVE)
        limits = tuple(ActiveLimit(LimitKind.CONSTRAINT, (name.partition(" ")[2],)) for name in names)
        return limits, max(0.0, float(slack.max(initial=0.0)))


def _unit_rows(constraint: Constraint, q: Array, v: Array) -> Answer | str:
    """Return a constraint's rows, scaled to unit norm, or a line that says why its answer cannot be used.

    Rows that every velocity satisfies are left out.
    """
    answer = answer_of(constraint.rows, q, v)
    if isinstance(answer, str):
        return answer
    matrix, lower = answer
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(matrix, axis=1)
        depends = norm >= _TINY
        if (lower[~depends] > 0.0).any():
            return "returned a row of zeros with a bound above 0, which nothing satisfies"
        matrix, lower = matrix[depends] / norm[depends, None], lower[depends] / norm[depends]
    if not (np.isfinite(norm).all() and np.isfinite(lower).all()):
        return "returned a number that is too large"
    return matrix, lower
