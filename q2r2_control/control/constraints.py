"""Linear constraints of a program's own on the next joint velocities: rows of the QP beside those of separation.

A soft one gives way as the rows of separation do. A hard one has no slack in the QP, and it is asked again before a
step is taken: velocities that break it are not executed, and the certified stop is. The certificate reads no row.
Neither kind can therefore break a limit or a distance, and no kind is part of what the stop is proven to keep.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from q2r2_control.control.answers import Answer, answer_of
from q2r2_control.errors import ConfigError, shown
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ActiveLimit, Array, LimitKind

HARD_TOLERANCE = 1e-4  # of a hard row of unit norm, which allows for a solver's own [rad/s]
_ACTIVE = 1e-7  # of any row of unit norm [rad/s]
_TINY = 1e-9  # a row with a smaller norm depends on no joint


class Constraint(Protocol):
    """A linear constraint on the next joint velocities: any object with this method.

    ``CartesianController(robot, settings, constraints=[MyConstraint()])`` adds it. It is soft, unless the object has an
    attribute ``hard`` that is True.

    **A hard constraint** holds the next velocities of every step that is not the stop: they satisfy A v+ >= lower to
    1e-4 rad/s, for rows of unit norm, with the A and lower of this step's start. Where the solver finds no such
    velocities, or none that can be certified, or where ``rows`` has no usable answer, the certified stop is executed
    instead. The stop was chosen before and knows nothing of the constraint, so arms may break it until they rest. That
    takes 0.3 s from full speed in the shipped cells. From then on the constraint holds if rest satisfies it, that is
    if no ``lower`` is above 0. Nothing is said about positions: a plane is kept as well as ``rows`` turns distances
    into velocities, and the stop may lead beyond it. Arms that can never satisfy it stay where they are.
    """

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The rows A v+ >= lower that the next joint velocities v+ are to satisfy.

        An equality is two rows, one the negative of the other. To keep a distance d(q) above 0 ask for
        J_d v+ >= -gain d, with the gradient J_d and a gain of about 5 /s. The method is asked at every substep and by
        :meth:`CartesianController.problem`, so its answer may depend on q and v alone.

        Args:
            q: Joint positions of the reference (nv,) [rad].
            v: Joint velocities of the reference (nv,) [rad/s].

        Returns:
            A (k, nv) and lower (k,), finite, with any k and rows of any norm. Another answer, and an exception, is not
            used: a soft constraint then asks for nothing, and at a hard one the arms brake. The step's report says so
            in ``faults``.
        """


class OwnConstraints:
    """The constraints of one controller, and the rows of those that answered at this step."""

    def __init__(self, robot: Robot, own: Sequence[Constraint]) -> None:
        """Raises :class:`ConfigError` for what is no constraint, and for one that has no usable rows at home."""
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
        self.matrix, self.lower = np.zeros((0, nv)), np.zeros(0)  # (k, nv), unit rows, and (k,) [rad/s]
        self.hard = 0  # how many of the last rows are hard
        self._names: list[str] = []  # of each row
        self._unknown = False  # whether some hard constraint has no usable answer

    def __bool__(self) -> bool:
        return bool(self._soft or self._hard)

    def write(self, q: Array, v: Array) -> tuple[str, ...]:
        """Ask every constraint at ``q`` and ``v`` for its rows; returns why some were not used."""
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
        """Whether ``v`` (nv,) [rad/s] satisfies every row, soft ones too."""
        return not self._unknown and bool((self.matrix @ v >= self.lower).all())

    def permit(self, v: Array) -> bool:
        """Whether ``v`` (nv,) [rad/s] may be executed: it satisfies the hard rows, and all of them are known."""
        first = len(self.lower) - self.hard
        return not self._unknown and bool((self.matrix[first:] @ v >= self.lower[first:] - HARD_TOLERANCE).all())

    def active(self, v: Array) -> tuple[tuple[ActiveLimit, ...], float]:
        """The constraints that ``v`` (nv,) meets or breaks, and the largest violation of a row [rad/s]."""
        slack = self.lower - self.matrix @ v
        names = dict.fromkeys(name for name, lacks in zip(self._names, slack, strict=True) if lacks >= -_ACTIVE)
        limits = tuple(ActiveLimit(LimitKind.CONSTRAINT, (name.partition(" ")[2],)) for name in names)
        return limits, max(0.0, float(slack.max(initial=0.0)))


def _unit_rows(constraint: Constraint, q: Array, v: Array) -> Answer | str:
    """Rows of unit norm, without those that depend on no joint and are satisfied; or why there are none."""
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
