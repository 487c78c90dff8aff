"""The Cartesian controller. It turns targets of the tools into joint motion that keeps limits and distances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.constraints import Constraint
from q2r2_control.control.held_targets import HeldTargets
from q2r2_control.control.jit import bound
from q2r2_control.control.kernel_model import kernel_model_of
from q2r2_control.control.qp import QpProblem, QpSolution, Solver
from q2r2_control.control.reference import move_reference, start_reference
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.control.safety.safety_filter import FOLLOWED, REDUCED, STOPPED
from q2r2_control.control.snapshot import put_back
from q2r2_control.control.solvers.guard import Guard
from q2r2_control.control.solvers.registry import solver_of
from q2r2_control.control.step_problem import GivenSolution, StepProblem
from q2r2_control.control.step_report import StepSummary
from q2r2_control.control.targets import TargetTracker
from q2r2_control.control.tasks.built_in import TaskData
from q2r2_control.control.tasks.external import Task, load_tasks
from q2r2_control.control.watched_pairs import WatchedPairs
from q2r2_control.errors import ConfigError, RobotError, check_kind, shown
from q2r2_control.robot.robot import Robot
from q2r2_control.types import LONGEST_DT, Array, Reference, StepReport, is_number, pose_of

if TYPE_CHECKING:
    import qpsolvers

_TARGETS = "a pin.SE3 or None by arm, such as {'left': pose}"


class CartesianController(WatchedPairs):
    """QP differential inverse kinematics for all arms of a cell together, with a certified stop at every tick.

    The contract holds for every sequence of targets and every dt in (0, 0.1] s. All numbers are finite, and no
    exception is raised. Joints keep their limits of position, velocity and acceleration. Every monitored pair keeps its
    distance, also between ticks and during a stop. This distance is ``min_distance``, unless ``distances`` or ``pairs``
    has another distance for the pair. If the targets stay constant, the arms come to rest. The reference is the
    controller's own state. It follows the targets and not the measured joints, so that noise never enters it.

    One tick is three calls. :func:`assemble` takes the targets, writes the QP and finds the minimum of its cost. If
    this minimum breaks a constraint, a solver solves the QP. :func:`move_reference` moves the reference by the part of
    the solution that can be certified. With :meth:`problem` and :meth:`advance`, your own program can solve the QP.

    Args:
        robot: The robot.
        settings: The settings; None for the defaults.
        solver: A solver's name, which replaces ``control.solver``, or an object that solves the QP of each step. This
            object gets copies of the QP's arrays (guard.py). Nothing that it returns, raises or writes can therefore
            break the contract.
        tasks: Your own costs, in addition to those of ``settings.tasks``.
        constraints: Your own constraints of the QP, soft or hard.
        bridge_held: Whether targets that come less often than steps are interpolated, see
            :mod:`q2r2_control.control.held_targets`. False is for a loop that has new targets at every step.

    Raises:
        ConfigError: If an argument has another type, if a task or a constraint has no usable answer at home, or if the
            settings do not fit the robot.
    """

    def __init__(
        self,
        robot: Robot,
        settings: ControllerSettings | None = None,
        *,
        solver: Solver | str | None = None,
        tasks: Sequence[Task] = (),
        constraints: Sequence[Constraint] = (),
        bridge_held: bool = True,
    ) -> None:
        check_kind("robot", robot, Robot, "a Robot, as Robot.from_config and Robot.from_urdf return")
        settings = ControllerSettings() if settings is None else settings
        check_kind("settings", settings, ControllerSettings, "ControllerSettings, which a Config has as config.control")
        if isinstance(solver, str):
            settings = settings.with_solver(solver)
        elif solver is not None and (isinstance(solver, type) or not callable(getattr(solver, "solve", None))):
            raise ConfigError(f"solver = {shown(solver)}: allowed: a solver's name, a Solver, or None: control.solver")
        super().__init__(robot, settings)
        self._nv = robot.model.nv
        if solver is None or isinstance(solver, str):
            self._solver = solver_of(settings, self._nv)
        else:
            self._solver = solver if isinstance(solver, Guard) else Guard(solver, self._nv)
        self._qp = StepProblem(robot, settings, tasks, constraints)
        self._tools: TaskData = self._data_pointer.value.tasks
        history = self._data_pointer.value.safety.history
        # The arrays that :meth:`withdraw` restores.
        self._restored = self._state.q, self._state.v, self._stop, *history.kept
        self._before = tuple(array.copy() for array in self._restored)  # Values of these arrays before the last step.
        self._kept_before = self._live.kept, self._objects.kept
        self._solution = np.zeros(self._nv)  # The solution of the QP, copied from the solver's array.
        self._held = HeldTargets() if bridge_held else None
        self._targets = TargetTracker(self._model_pointer.value.tasks, self._arms, settings)
        self._compile()
        self.reset(robot.home)

    @property
    def settings(self) -> ControllerSettings:
        """The settings of the last :meth:`change`; before it, the settings of the constructor."""
        return self._live.settings

    def change(self, values: Mapping[str, Any]) -> str | None:
        """Change settings whose names are in ``LIVE``, from the next step on.

        Returns None, or the reason why the change is not possible. Gains change within half a second. A smaller
        ``min_distance`` counts at once. A greater ``min_distance`` counts for each pair as soon as it is certified
        (:attr:`kept_distances`). It is refused if some pair is too close for it in the home posture.
        """
        try:
            refused = self._live.change(self.settings.changed(values))
        except ConfigError as error:
            return str(error)
        self._obstacles.change(self.settings)
        self._observe_again(self._unchanged)
        return refused

    def _compile(self) -> None:
        """Run every kernel and the solver once, so that nothing is compiled or set up while arms move."""
        model, data = self._model_pointer, self._data_pointer
        self.reset(self.robot.home)
        self._qp.connect(model, self._targets.pointer, data)
        self._move = bound(move_reference, model, data, self._solution, False, self.settings.max_substep, 1.0)
        self.step({arm: self.tool_pose(arm) for arm in self._arms}, self.settings.max_substep)
        problem = self._qp.problem
        # The minimum of the cost may be the solution at home, and the solver would then not be set up. The minimum is
        # therefore removed.
        problem.minimum = None
        self._solver.solve(problem)

    def reset(self, q: Array, v: Array | None = None) -> None:
        """Start again at joint positions ``q`` (nv,) [rad] and velocities ``v`` (nv,) [rad/s].

        Targets, openings and held objects are forgotten. Moving obstacles stay where they are. Joints may start outside
        their limits, and bodies may penetrate each other at the start: the controller recovers from both.

        Raises:
            RobotError: If an array has another shape, or a number that is not finite.
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
        if self._held is not None:
            self._held.clear()
        self._obstacles.keep_clear(0.0)
        proven = start_reference(self._model_pointer, self._data_pointer)
        self._live.begin()
        self._observe_again(self._unchanged)
        self._certified = proven and self._apart

    def step(self, targets: Mapping[str, pin.SE3 | None], dt: float, posture: Array | None = None) -> Reference:
        """Move the reference by one step towards the targets.

        Args:
            targets: Poses of the tools by arm, in the world frame. An arm without a target, or with None, holds. If a
                target is not a finite pose, the arm keeps its last target, and the report names the arm. If the last
                target was held for several steps, up to 110 ms, the motion to the next target is interpolated. It takes
                1.25 times as long as the last target was held.
            dt: Duration of the step [s]. If it is above 0.1 s, the reference moves as in a step of 0.1 s. If it is not
                above 0, the reference does not move.
            posture: The posture to which the joints move as far as the tools leave them free (nv,) [rad]; None for
                home. A posture that is not finite is not used.

        Returns:
            The new reference, with arrays that no later step changes.

        Raises:
            RobotError: If ``targets`` is not a mapping.
        """
        return self._tick(targets, dt, posture, self._solver.solve)

    def problem(
        self, targets: Mapping[str, pin.SE3 | None], dt: float, posture: Array | None = None
    ) -> qpsolvers.Problem:
        """Return the QP that :meth:`step` would solve now. The controller does not change.

            minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i,    rho_i = 1e-5 a_i' H^-1 a_i,  a_i the i-th row
            subject to  lower <= v <= upper,    rows v + s >= rows_lower,    s >= 0

        The variables are x = [v; s]: the next joint velocities (nv,) and a slack for each row (m,) [rad/s]. Rows have
        unit norm. The rows of separation come first, then the soft and the hard rows of ``constraints``. The slack of a
        hard row has the upper bound 0. ``qpsolvers.solve_problem(problem, solver=NAME)`` solves the problem, and
        :meth:`advance` takes the solution.

        Args:
            targets: As in :meth:`step`.
            dt: Duration of the step, above 0 and up to 0.1 [s]. If it is above ``max_substep``, the step is split, and
                the QP of the first part is returned.
            posture: As in :meth:`step`.

        Returns:
            The problem, with arrays that no later step changes.

        Raises:
            RobotError: If ``targets`` is not a mapping, or ``dt`` is not allowed.
        """
        # The import is inside this method, because it is slow: it loads every solver.
        from q2r2_control.control.solvers.qpsolvers import slack_problem

        check_kind("targets", targets, Mapping, _TARGETS, RobotError)
        if not _passes(dt) or dt > LONGEST_DT:
            raise RobotError(f"dt = {shown(dt)}: allowed: a number above 0, up to {LONGEST_DT:g} s")
        if self._held is not None:
            targets = self._held.peek(targets, float(dt))
        with put_back((*self._kernel_values, self._targets.pointer.value), (self._live, self._objects)):
            self._targets.aim_posture(posture)
            self._targets.offer(targets)
            self._write_problem(float(dt) / self._parts_of(float(dt)), float(dt), StepSummary())
            return slack_problem(self._qp.problem)

    def advance(
        self, x: npt.ArrayLike | None, targets: Mapping[str, pin.SE3 | None], dt: float, posture: Array | None = None
    ) -> Reference:
        """Take a step with a solution of :meth:`problem` that your program has found. It is certified as every step is.

        The result is the same as that of :meth:`step` with a solver that finds this solution. ``x`` is not trusted: it
        is clamped to the bounds, and executed as far as it can be certified. None, fewer than nv numbers, another
        shape, and numbers that are not finite count as a failed solve. Then the certified stop is executed, and
        ``report.unsolved`` says so.

        Args:
            x: Next joint velocities (nv,) [rad/s]. The slacks may follow them, as in a solution of the whole problem.
                All parts of a dt above ``max_substep`` use the same velocities.
            targets: The same targets as in the call of :meth:`problem`.
            dt: As in :meth:`step` [s].
            posture: As in :meth:`step`.

        Returns:
            The new reference, with arrays that no later step changes.

        Raises:
            RobotError: If ``targets`` is not a mapping.
        """
        return self._tick(targets, dt, posture, GivenSolution(x, self._nv).solve)

    def _tick(
        self,
        targets: Mapping[str, pin.SE3 | None],
        dt: float,
        posture: Array | None,
        solve: Callable[[QpProblem], QpSolution],
    ) -> Reference:
        check_kind("targets", targets, Mapping, _TARGETS, RobotError)
        usable = _passes(dt)
        time = min(float(dt), LONGEST_DT) if usable else 0.0
        self._remember()
        self._targets.aim_posture(posture)
        summary = StepSummary()
        if usable and dt > time:
            self._obstacles.pass_time(float(dt) - time)
        if self._held is not None and time > 0.0:
            targets = self._held.between(targets, time)
        known = self._targets.offer(targets)
        if time > 0.0:
            parts = self._parts_of(time)
            for index in range(parts):
                if not self._take_part(time / parts, 1.0 / parts, -1.0 if index else time, summary, solve):
                    summary.unsolved |= 1 << index
        else:  # The targets are stored, and the reference does not move.
            self._qp.take_targets(summary)
        rejected = () if known and summary.targets_usable else self._targets.rejected(targets)
        if rejected:
            summary.faults += self._targets.why_rejected(targets, rejected)
        if summary.unsolved and (why := self.solver_failure) is not None:
            summary.faults += (f"solver: {why}",)
        return self._reference(summary, usable and dt <= LONGEST_DT, rejected)

    def _parts_of(self, time: float) -> int:
        """Return the number of equal steps of at most ``max_substep`` into which a ``time`` [s] is split."""
        return max(math.ceil(time / self.settings.max_substep - 1e-9), 1)

    def _reference(self, summary: StepSummary, dt_usable: bool, rejected: tuple[str, ...] = ()) -> Reference:
        closest, distance, tightest, margin = self._observed
        report = StepReport(
            status=summary.status(self._apart, dt_usable, rejected),
            rejected=rejected,
            binding=self._names.of(self._active) + summary.constraints,
            closest_pair=self._names.pair(closest),
            closest_distance=distance,
            certified=self._certified,
            fallback=summary.fallback,
            slack=summary.slack,
            solve_time=summary.solve_time,
            tightest_pair=self._names.pair(tightest),
            margin=margin,
            unsolved=summary.unsolved,
            faults=tuple(dict.fromkeys(summary.faults)) if summary.faults else (),
        )
        state = self._state
        return Reference(state.q.copy(), state.v.copy(), state.a.copy(), report)

    def brake(self, dt: float) -> Reference:
        """Move the reference by ``dt`` [s] along its certified stop. The remaining part of the stop stays certified.

        When the stop ends, the reference is at rest. With a dt that is not above 0, the reference does not move.
        """
        self._remember()
        self._state.a[:] = 0.0
        usable = _passes(dt)
        if usable:
            self._obstacles.pass_time(dt)
            self._observed, _, _ = self._move(self._model_pointer, self._data_pointer, self._solution, False, dt, 1.0)
            self._apart = self._observed[-1] >= -ROUNDING
        self._active.used[0] = 0  # No limit is active, because no target is followed.
        return self._reference(StepSummary(), usable)

    def _remember(self) -> None:
        """Remember the state to which :meth:`withdraw` returns, and the distances that pairs keep in this state."""
        self._kept_before = self._live.kept, self._objects.kept
        for kept, array in zip(self._before, self._restored, strict=True):
            kept[:] = array

    def withdraw(self, reference: Reference) -> None:
        """Undo the last step, because its ``reference`` came too late for the plant, and the plant has begun to brake.

        The controller gets back the state and the certified stop from before the step. Positions and velocities of this
        state are also written into ``reference``.

        Raises:
            RobotError: If ``reference`` is not a reference.
        """
        check_kind("reference", reference, Reference, "the Reference that the last step returned", RobotError)
        for array, kept in zip(self._restored, self._before, strict=True):
            array[:] = kept
        reference.q[:], reference.v[:] = self._state.q, self._state.v
        # The withdrawn step may have increased the kept distances beyond those at the restored posture. They are
        # therefore reduced to their values before the step.
        pairs_kept, objects_kept = self._kept_before
        self._live.keep_no_more_than(pairs_kept)
        self._objects.keep_no_more_than(objects_kept)
        self._observe_again(self._unchanged)

    def hold_at(self, q: Array | None) -> None:
        """Let arms without a target go to the posture ``q`` and stay there. They keep all limits and distances.

        The speed of a joint is 4 /s times its remaining distance. For slower motion, change ``q`` slowly from call to
        call.

        Args:
            q: The posture (nv,) [rad]; None lets arms hold where they come to rest.

        Raises:
            RobotError: If ``q`` has another shape, or a number that is not finite.
        """
        self._targets.hold_at(None if q is None else self.robot.checked("q", q))

    def tool_pose(self, arm: str) -> pin.SE3:
        """Return the pose of an arm's tool at the reference, in the world frame.

        Raises:
            RobotError: If there is no such arm.
        """
        i = self._arms.index(self.robot.arm(arm).name)
        return pose_of(self._tools.rotation[i], self._tools.translation[i])

    @property
    def solver_failure(self) -> str | None:
        """The reason why the solver's last answer was no solution; None if it was a solution.

        With our own DAQP it is always None.
        """
        return getattr(self._solver, "failure", None)

    @property
    def stop_deceleration(self) -> Array:
        """Deceleration of each joint in the certified stop from the reference (nv,) [rad/s^2]."""
        return self._stop.copy()

    def _write_problem(self, h: float, tick: float, summary: StepSummary) -> None:
        """Write the QP of a step of ``h`` [s]. See :func:`assemble` for ``tick``."""
        self._live.step(h)
        self._obstacles.keep_clear(h)
        self._qp.write(h, tick, summary)

    def _take_part(
        self, h: float, share: float, tick: float, summary: StepSummary, solve: Callable[[QpProblem], QpSolution]
    ) -> bool:
        """Build and solve the QP of one substep, certify the solution and move; return whether the QP was solved.

        ``h`` is the duration of the substep [s], and ``share`` is ``h`` divided by the duration of the tick.
        """
        self._write_problem(h, tick, summary)
        solution = solve(self._qp.problem)
        limit = self.settings.solve_time_limit
        solved = solution.v is not None and (limit is None or solution.solve_time <= limit)
        if solved:
            self._solution[:] = solution.v
        if self._qp.constraints:
            outcome, slack = self._move_as_permitted(solved, h, share, summary)
        else:
            self._observed, outcome, slack = self._move(
                self._model_pointer, self._data_pointer, self._solution, solved, h, share
            )
        summary.fallback |= outcome != FOLLOWED
        summary.slack = max(summary.slack, slack)
        summary.solve_time += solution.solve_time
        was_apart, self._apart = self._apart, self._observed[-1] >= -ROUNDING
        # If the arms have stopped along a certified stop, its remaining part stays certified. Any other step was
        # certified in this call, but its proof is complete only if all pairs kept their distance before the step.
        self._certified = self._apart and (self._certified if outcome == STOPPED else was_apart)
        return solved

    def _move_as_permitted(self, solved: bool, h: float, share: float, summary: StepSummary) -> tuple[int, float]:
        """Move by the solution if the hard constraints permit it, or otherwise along the certified stop.

        The safety filter may mix the solution with the stop. The mixture is then checked against the constraints. If it
        breaks a constraint, the move is undone: posture, velocity and the known stop (safety_filter.py) get their
        values from before the step. A stop depends only on these values, so the stop that was certified before is
        executed.
        """
        own, problem, state = self._qp.constraints, self._qp.problem, self._state
        usable = solved and own.permit(np.clip(self._solution, problem.lower, problem.upper))
        arrays = *self._restored, state.a
        before = [array.copy() for array in arrays]
        pointers = self._model_pointer, self._data_pointer
        self._observed, outcome, slack = self._move(*pointers, self._solution, usable, h, share)
        if outcome == REDUCED and not own.permit(state.v):
            for array, kept in zip(arrays, before, strict=True):
                array[:] = kept
            self._observe_again(self._unchanged)
            self._observed, outcome, slack = self._move(*pointers, self._solution, False, h, share)
        summary.constraints, own_slack = own.active(state.v)
        return outcome, max(slack, own_slack)


def check_settings(robot: Robot, settings: ControllerSettings) -> None:
    """Check ``settings`` for ``robot`` without compiling a kernel.

    Raises:
        ConfigError: If the settings name something that the robot does not have, or a task cannot be made.
        RobotError: If the kernels cannot handle a joint or the shape of a body.
    """
    kernel_model_of(robot, settings)
    load_tasks(robot, settings.tasks)


def _passes(dt: object) -> bool:
    """Return whether ``dt`` is a number of seconds above 0."""
    return is_number(dt) and dt > 0.0
