"""The Cartesian controller: tool targets in, joint motion out that keeps every limit and keeps the arms apart."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.jit import hold
from q2r2_control.control.kernel_data import Workspace
from q2r2_control.control.kernel_model import cell_of
from q2r2_control.control.qp import QpProblem, Solver, make_solver
from q2r2_control.control.qp_assembly import assemble
from q2r2_control.control.safety.joint_limits import ACCELERATION, POSITION, VELOCITY
from q2r2_control.control.safety.safety_filter import FOLLOWED, STOPPED, commit, first_look
from q2r2_control.control.targets import GoalTracker
from q2r2_control.errors import RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Reference, StepReport, StepStatus

LONGEST_DT = 0.1  # [s]; a longer gap between ticks moves the reference no further than this
_LIMIT_NAMES = {POSITION: "position", VELOCITY: "velocity", ACCELERATION: "acceleration"}


class CartesianController:
    """QP differential inverse kinematics for all arms of a cell at once, with a certified stop at every tick.

    The contract, for every sequence of targets and every dt in (0, 0.1] s: finite numbers, no exception; joint
    position, velocity and acceleration limits; every monitored pair at ``min_distance``, also between ticks and during
    a stop; rest under a constant target. The reference is the controller's own state: it follows the targets, not the
    plant's measurement, so that noise never enters it.

    One tick is three calls: :func:`assemble` writes the QP, a solver solves it, :func:`commit` takes of the solution
    what can be certified and moves the reference.
    """

    def __init__(
        self, robot: Robot, settings: ControllerSettings | None = None, *, solver: Solver | None = None
    ) -> None:
        self.robot = robot
        self.settings = settings or ControllerSettings()
        self._nv = robot.model.nv
        self._arms = tuple(robot.arms)
        self._solver = solver or make_solver(self.settings.solver, self._nv, self.settings.solve_time_limit)
        cell = cell_of(robot, self.settings)
        self._work = Workspace.empty(cell)
        self._goals = GoalTracker(cell, self._arms, self.settings)
        self._held_cell, self._held_work = hold(cell), hold(self._work)
        names = [geometry.name for geometry in robot.collision_model.geometryObjects]
        pairs = zip(cell.pairs.first.tolist(), cell.pairs.second.tolist(), strict=True)
        self._pair_names = [(names[first], names[second]) for first, second in pairs]
        self._compile()
        self.reset(robot.home)

    def _compile(self) -> None:
        """Run every kernel once, so that none is compiled in mid-motion."""
        self.reset(self.robot.home)
        self.step({arm: self.tool_pose(arm) for arm in self._arms}, self.settings.max_substep)

    def reset(self, q: Array, v: Array | None = None) -> None:
        """Start anew at joint positions ``q`` [rad] and velocities ``v`` [rad/s], (nv,) each; goals are forgotten.

        Raises :class:`RobotError` for a wrong shape or a number that is not finite. A start outside the limits or in
        penetration is allowed: the controller recovers from it.
        """
        self._work.q[:] = self._checked("q", q)
        self._work.v[:] = 0.0 if v is None else self._checked("v", v)
        self._goals.reset(self._work.q)
        self._closest, self._distance, proven = first_look(self._held_cell, self._held_work)
        self._apart = self._distance >= self.settings.min_distance
        self._certified = proven and self._apart

    def _checked(self, name: str, values: Array) -> Array:
        array = np.array(values, dtype=np.float64)
        if array.shape != (self._nv,) or not np.isfinite(array).all():
            raise RobotError(f"reset: {name} = {values!r:.80}: expected {self._nv} finite numbers")
        return array

    def step(self, targets: Mapping[str, pin.SE3 | None], dt: float, posture: Array | None = None) -> Reference:
        """Move the reference by ``dt`` seconds towards the tool ``targets`` (world frame).

        An arm that is missing or None holds. A target that is not a finite pose is not used: the arm's last target
        stays, and the report names the arm. A dt that is not in (0, 0.1] s moves nothing, or no more than 0.1 s.

        ``posture`` (nv,) [rad] is what arms that follow a target take as far as their tools leave them free to; without
        it that is home. Where something else moves the arms it is what was measured, so that the reference's elbows
        are where the arms' are. One that is not nv finite numbers is not used: the last one stays.
        """
        usable = isinstance(dt, int | float | np.floating) and math.isfinite(dt) and dt > 0.0
        time = min(float(dt), LONGEST_DT) if usable else 0.0
        work = self._work
        self._goals.aim_posture(posture)
        rejected = self._goals.update(targets, time, work.q, work.v)
        work.a[:] = 0.0
        summary = _Summary()
        if time > 0.0:
            substeps = max(math.ceil(time / self.settings.max_substep - 1e-9), 1)
            for _ in range(substeps):
                self._advance(time / substeps, 1.0 / substeps, summary)
        report = StepReport(
            status=self._status(usable and dt <= LONGEST_DT, rejected, summary),
            rejected=rejected,
            binding=self._binding(),
            closest_pair=self._pair_names[self._closest] if self._pair_names else ("", ""),
            closest_distance=self._distance,
            certified=self._certified,
            fallback=summary.fallback,
            slack=summary.slack,
            solve_time=summary.solve_time,
        )
        return Reference(work.q.copy(), work.v.copy(), work.a.copy(), report)

    def tool_pose(self, arm: str) -> pin.SE3:
        """World pose of an arm's tool at the reference."""
        i = self._arms.index(arm)
        return pin.SE3(self._work.rotation[i].copy(), self._work.translation[i].copy())

    def _advance(self, h: float, share: float, summary: _Summary) -> None:
        """One substep, which is a ``share`` of the tick: build, solve, certify and move."""
        work = self._work
        summary.inside &= assemble(self._held_cell, self._goals.held, self._held_work, h)
        count = int(work.rows.used[0])
        problem = QpProblem(
            H=work.H,
            g=work.g,
            lower=work.box_lower,
            upper=work.box_upper,
            rows=work.rows.matrix[:count],
            rows_lower=work.rows.lower[:count],
        )
        solution = self._solver.solve(problem)
        limit = self.settings.solve_time_limit
        usable = solution.v is not None and (limit is None or solution.solve_time <= limit)
        wanted = solution.v if usable else work.wanted
        outcome, self._closest, self._distance, slack = commit(
            self._held_cell, self._held_work, wanted, usable, h, share
        )
        summary.fallback |= outcome != FOLLOWED
        summary.slack = max(summary.slack, slack)
        summary.solve_time += solution.solve_time
        was_apart, self._apart = self._apart, self._distance >= self.settings.min_distance
        # A certified stop stays certified. Anything else was proven just now, and if all was apart before, in full.
        self._certified = self._apart and (self._certified if outcome == STOPPED else was_apart)

    def _status(self, dt_usable: bool, rejected: tuple[str, ...], summary: _Summary) -> StepStatus:
        if summary.fallback:
            return StepStatus.FALLBACK
        if not (summary.inside and self._apart):
            return StepStatus.RECOVERING
        if not dt_usable:
            return StepStatus.DT_REJECTED
        return StepStatus.TARGET_REJECTED if rejected else StepStatus.OK

    def _binding(self) -> tuple[str, ...]:
        """Names of limits and pairs that held the last step back."""
        active = self._work.active
        found = int(active.used[0])
        if not found:
            return ()
        return tuple(dict.fromkeys(self._limit_name(code) for code in active.code[:found].tolist()))

    def _limit_name(self, code: int) -> str:
        if code < 0:
            return "|".join(self._pair_names[-1 - code])
        joint, kind = divmod(code, 4)
        return f"{self.robot.joint_names[joint]} {_LIMIT_NAMES[kind]}"


class _Summary:
    """What the substeps of one tick add up to."""

    def __init__(self) -> None:
        self.fallback = False
        self.inside = True
        self.slack = 0.0
        self.solve_time = 0.0
