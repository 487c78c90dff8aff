"""The Cartesian controller: tool targets in, joint motion out that keeps every limit and keeps the arms apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.jit import bound
from q2r2_control.control.qp import DaqpSolver, QpProblem, Solver, assemble, find_minimum
from q2r2_control.control.reference import move_reference, start_reference
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.control.safety.safety_filter import FOLLOWED, STOPPED
from q2r2_control.control.step_report import StepSummary
from q2r2_control.control.targets import TargetTracker
from q2r2_control.control.tasks.external import ExternalTasks, Task
from q2r2_control.control.watched_pairs import WatchedPairs
from q2r2_control.errors import ConfigError, RobotError, check_kind, shown
from q2r2_control.robot.robot import Robot
from q2r2_control.types import LONGEST_DT, Array, Reference, StepReport, pose_of

_NUMBER = (float, int, np.floating)


class CartesianController(WatchedPairs):
    """QP differential inverse kinematics for all arms of a cell at once, with a certified stop at every tick.

    The contract, for every sequence of targets and every dt in (0, 0.1] s, is this. Numbers are finite, and no
    exception is raised. Joints keep their position, velocity and acceleration limits. Every monitored pair keeps its
    distance (``min_distance``, or that of ``distances`` and ``pairs``), also between ticks and during a stop. A
    constant target ends in rest. The reference is the controller's own state: it follows the targets, not the plant's
    measurement, so that noise never enters it.

    One tick is three calls. :func:`assemble` takes the targets, writes the QP and finds the minimum of its cost. A
    solver solves it where that is not the solution. :func:`move_reference` takes the part of the solution that can be
    certified, and moves the reference. A ``solver`` that is given in place of DAQP is asked at every tick.
    """

    def __init__(
        self,
        robot: Robot,
        settings: ControllerSettings | None = None,
        *,
        solver: Solver | None = None,
        tasks: Sequence[Task] = (),
    ) -> None:
        check_kind("robot", robot, Robot, "a Robot, as Robot.from_config and Robot.from_urdf return")
        settings = ControllerSettings() if settings is None else settings
        check_kind("settings", settings, ControllerSettings, "ControllerSettings, which a Config has as config.control")
        if solver is not None and not callable(getattr(solver, "solve", None)):
            raise ConfigError(f"solver = {shown(solver)}: allowed: a Solver, or None for DAQP")
        super().__init__(robot, settings)
        self._nv = robot.model.nv
        self._solver = DaqpSolver(self._nv, settings.solve_time_limit) if solver is None else solver
        model, data = self._model_pointer.value, self._data_pointer.value
        self._rows, self._tasks = data.safety.rows, data.tasks
        self._before = tuple(array.copy() for array in (self._state.q, self._state.v, self._stop))  # the last step
        self._solution = np.zeros(self._nv)  # of the QP, whatever array has it
        self._problem = QpProblem(
            H=data.tasks.H,
            g=data.tasks.g,
            lower=data.safety.box.lower,
            upper=data.safety.box.upper,
            rows=self._rows.matrix[:0],
            rows_lower=self._rows.lower[:0],
        )
        self._targets = TargetTracker(model.tasks, self._arms, settings)
        self._external_tasks = ExternalTasks(robot, settings.tasks, tasks)
        self._compile()
        self.reset(robot.home)

    @property
    def settings(self) -> ControllerSettings:
        """The settings that were asked for, by :meth:`change` or at first."""
        return self._live.settings

    def change(self, values: Mapping[str, Any]) -> str | None:
        """Go by other settings from the next step on, by name as in ``LIVE``; returns why not, or None.

        Gains change over half a second. A smaller ``min_distance`` counts at once; a greater one for each pair as far
        as it is proven (:attr:`kept_distances`). One that home does not keep is not possible.
        """
        try:
            refused = self._live.change(self.settings.changed(values))
        except ConfigError as error:
            return str(error)
        self._obstacles.change(self.settings)
        self._observe_again(self._unchanged)
        return refused

    def _compile(self) -> None:
        """Run every kernel and the solver once, so that none is compiled or set up in mid-motion."""
        model, data, targets = self._model_pointer, self._data_pointer, self._targets.pointer
        self.reset(self.robot.home)
        self._assemble = bound(assemble, model, targets, data, self.settings.max_substep, -1.0)
        self._move = bound(move_reference, model, data, self._solution, False, self.settings.max_substep, 1.0)
        if self._external_tasks:
            self._find_minimum = bound(find_minimum, data)
        self.step({arm: self.tool_pose(arm) for arm in self._arms}, self.settings.max_substep)
        self._problem.minimum = None  # a solver is set up at its first problem, and at home there may be none for it
        self._solver.solve(self._problem)

    def reset(self, q: Array, v: Array | None = None) -> None:
        """Start anew at joint positions ``q`` [rad] and velocities ``v`` [rad/s], (nv,) each.

        Targets and openings are forgotten, and nothing is held. Moving obstacles stay where they are. A start outside
        the limits or in penetration is allowed: the controller recovers from it. Raises :class:`RobotError` for a
        wrong shape or no finite number.
        """
        state = self._state
        posture, velocity = self.robot.checked("q", q), 0.0 if v is None else self.robot.checked("v", v)
        state.q[:], state.v[:] = posture, velocity
        self._fingers.set_all({})
        self._objects.clear()
        self._obstacles.hold(self._objects.holding)
        self._active.used[0] = 0
        self._live.restart()
        self._targets.reset(state.q)
        self._obstacles.keep_clear(0.0)
        proven = start_reference(self._model_pointer, self._data_pointer)
        self._live.begin()
        self._observe_again(self._unchanged)
        self._certified = proven and self._apart

    def step(self, targets: Mapping[str, pin.SE3 | None], dt: float, posture: Array | None = None) -> Reference:
        """Move the reference by ``dt`` seconds towards the tool ``targets`` (world frame).

        An arm that is missing or None holds. A target that is not a finite pose is not used: the arm's last target
        stays, and the report names the arm. A dt that is not in (0, 0.1] s moves nothing, or no more than 0.1 s.
        Joints that the tools leave free go to ``posture`` (nv,) [rad], or home; one that is not finite is not used.
        Raises :class:`RobotError` for ``targets`` that are no mapping.
        """
        check_kind("targets", targets, Mapping, "a pin.SE3 or None by arm, such as {'left': pose}", RobotError)
        usable = _passes(dt)
        time = min(float(dt), LONGEST_DT) if usable else 0.0
        self._remember()
        self._targets.aim_posture(posture)
        summary = StepSummary()
        if usable and dt > time:
            self._obstacles.pass_time(float(dt) - time)
        known, longest = self._targets.offer(targets), self.settings.max_substep
        if time > 0.0:
            substeps = max(math.ceil(time / longest - 1e-9), 1)
            for index in range(substeps):
                if not self._advance(time / substeps, 1.0 / substeps, -1.0 if index else time, summary):
                    summary.unsolved |= 1 << index
        else:  # takes the targets, and moves nothing
            pointers = self._model_pointer, self._targets.pointer, self._data_pointer
            summary.targets_usable, _, _ = self._assemble(*pointers, longest, 0.0)
        rejected = () if known and summary.targets_usable else self._targets.rejected(targets)
        return self._reference(summary, usable and dt <= LONGEST_DT, rejected)

    def _reference(self, summary: StepSummary, dt_usable: bool, rejected: tuple[str, ...] = ()) -> Reference:
        closest, distance, tightest, margin = self._observed
        report = StepReport(
            status=summary.status(self._apart, dt_usable, rejected),
            rejected=rejected,
            binding=self._names.of(self._active),
            closest_pair=self._names.pair(closest),
            closest_distance=distance,
            certified=self._certified,
            fallback=summary.fallback,
            slack=summary.slack,
            solve_time=summary.solve_time,
            tightest_pair=self._names.pair(tightest),
            margin=margin,
            unsolved=summary.unsolved,
            faults=tuple(dict.fromkeys(summary.faults)),
        )
        state = self._state
        return Reference(state.q.copy(), state.v.copy(), state.a.copy(), report)

    def brake(self, dt: float) -> Reference:
        """Move the reference by ``dt`` [s] along its certified stop, of which the rest stays certified.

        Nothing else moves it: it is at rest when the stop ends. A dt that :meth:`step` does not use moves nothing.
        """
        self._remember()
        self._state.a[:] = 0.0
        usable = _passes(dt)
        if usable:
            self._obstacles.pass_time(dt)
            self._observed, _, _ = self._move(self._model_pointer, self._data_pointer, self._solution, False, dt, 1.0)
            self._apart = self._observed[-1] >= -ROUNDING
        self._active.used[0] = 0  # no limit holds it back from anything
        return self._reference(StepSummary(), usable)

    def _remember(self) -> None:
        """The state to which :meth:`withdraw` returns."""
        for kept, array in zip(self._before, (self._state.q, self._state.v, self._stop), strict=True):
            kept[:] = array

    def withdraw(self, reference: Reference) -> None:
        """Undo the last step, whose ``reference`` came too late for the plant: be where the arms went on braking from.

        The state and the certified stop are those before the step, and ``reference`` becomes that state. Raises
        :class:`RobotError` for what is no reference.
        """
        check_kind("reference", reference, Reference, "the Reference that the last step returned", RobotError)
        for array, kept in zip((self._state.q, self._state.v, self._stop), self._before, strict=True):
            array[:] = kept
        reference.q[:], reference.v[:] = self._state.q, self._state.v
        self._observe_again(self._unchanged)

    def hold_at(self, q: Array | None) -> None:
        """Let arms without a target go to joint positions ``q`` (nv,) [rad] and hold there, within every promise.

        As fast as a gain of 4 /s of the way that is left, so ``q`` should move as the arms should. None: they hold
        where they come to rest, as they do anyhow after a target. Raises :class:`RobotError` as :meth:`reset` does.
        """
        self._targets.hold_at(None if q is None else self.robot.checked("q", q))

    def tool_pose(self, arm: str) -> pin.SE3:
        """World pose of an arm's tool at the reference. Raises :class:`RobotError` for an arm that does not exist."""
        i = self._arms.index(self.robot.arm(arm).name)
        return pose_of(self._tasks.rotation[i], self._tasks.translation[i])

    @property
    def stop_deceleration(self) -> Array:
        """Of each joint in the full stop from the reference that is known, (nv,) [rad/s^2]."""
        return self._stop.copy()

    def _advance(self, h: float, share: float, tick: float, summary: StepSummary) -> bool:
        """One substep, which is a ``share`` of the tick: build, solve, certify and move; whether it was solved.

        ``tick``: see :func:`assemble`.
        """
        self._live.step(h)
        self._obstacles.keep_clear(h)
        usable, inside, free = self._assemble(self._model_pointer, self._targets.pointer, self._data_pointer, h, tick)
        if self._external_tasks:
            state = self._state
            summary.faults += self._external_tasks.add_costs(self._tasks.H, self._tasks.g, state.q, state.v)
            free = self._find_minimum(self._data_pointer)
        summary.targets_usable &= usable
        summary.inside &= inside
        count = int(self._rows.used[0])
        self._problem.rows, self._problem.rows_lower = self._rows.matrix[:count], self._rows.lower[:count]
        self._problem.minimum = self._tasks.minimum if free else None
        solution = self._solver.solve(self._problem)
        limit = self.settings.solve_time_limit
        solved = solution.v is not None and (limit is None or solution.solve_time <= limit)
        if solved:
            self._solution[:] = solution.v
        self._observed, outcome, slack = self._move(
            self._model_pointer, self._data_pointer, self._solution, solved, h, share
        )
        summary.fallback |= outcome != FOLLOWED
        summary.slack = max(summary.slack, slack)
        summary.solve_time += solution.solve_time
        was_apart, self._apart = self._apart, self._observed[-1] >= -ROUNDING
        # A certified stop stays certified. Anything else was proven just now, and if all was apart before, in full.
        self._certified = self._apart and (self._certified if outcome == STOPPED else was_apart)
        return solved


def _passes(dt: float) -> bool:
    """Whether ``dt`` [s] is a time in which something may move."""
    return isinstance(dt, _NUMBER) and math.isfinite(dt) and dt > 0.0
