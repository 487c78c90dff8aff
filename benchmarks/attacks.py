"""What can attacks without targets achieve? They use hostile solvers, invalid arguments, and a loop that stalls."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import typer

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import QpProblem, QpSolution
from q2r2_control.drives.base import make_drive
from q2r2_control.loop.control_loop import ControlLoop
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.joint_watch import watch_settings
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.types import SIDES, Array, CommandMode, RobotState
from q2r2_control.verification.fault_injection import PushingSolver
from q2r2_control.viewer.tables import figure_table

_DT = 0.002  # Period of the ticks, unless a row of the table names another period [s].
_TOOL_SPEED = 0.25  # In one row of the table, the cell promises that no tool is faster than this [m/s].
_LOOP_DT = 0.004  # Period of the loop that stalls [s].
_BALL = 0.1  # Radius of the moving body [m].


@dataclass(frozen=True, slots=True)
class Row:
    """One figure of an attack: the value that the attack reached, and the values that are allowed."""

    attack: str
    figure: str
    reached: float
    allowed: str


class _Writer:
    """A solver that widens the limits in its problem if it can, and returns velocities beyond the limits."""

    def solve(self, problem: QpProblem) -> QpSolution:
        for array, change in ((problem.lower, -1.0), (problem.upper, 1.0), (problem.rows_lower, -1.0)):
            with suppress(ValueError):  # A ValueError means that the array is read-only.
                array += change
        return QpSolution(problem.upper + 1.0, 0.0)


class _Blocker:
    """A solver that blocks for 0.2 s, but reports a solve time of 0 s."""

    def solve(self, problem: QpProblem) -> QpSolution:
        time.sleep(0.2)
        return QpSolution(np.zeros(len(problem.g)), 0.0)


def _crossing(controller: CartesianController) -> dict[str, pin.SE3 | None]:
    """Return a target for each tool, at the present position of the other tool."""
    left, right = (controller.tool_pose(arm) for arm in SIDES)
    return {"left": pin.SE3(left.rotation, right.translation), "right": pin.SE3(right.rotation, left.translation)}


def writing_solver(robot: Robot, settings: Any) -> Iterator[Row]:
    controller = CartesianController(robot, settings, solver=_Writer())
    limit, v, acceleration, speed = (
        robot.capped_acceleration(settings.acceleration_limit),
        np.zeros(robot.model.nv),
        0.0,
        0.0,
    )
    for _ in range(500):
        reference = controller.step(_crossing(controller), _DT)
        acceleration = max(acceleration, float(np.max(np.abs(reference.v - v) / (limit * _DT))))
        speed = max(speed, float(np.max(np.abs(reference.v) / robot.velocity_limit)))
        v = reference.v
    yield Row("a solver that writes into its limits", "acceleration / limit", acceleration, "1")
    yield Row("", "velocity / limit", speed, "1")


def blocking_solver(robot: Robot, settings: Any) -> Iterator[Row]:
    controller = CartesianController(robot, settings, solver=_Blocker())
    late = sum(controller.step(_crossing(controller), _DT).report.unsolved for _ in range(10))
    yield Row("a solver that blocks for 0.2 s and denies it", "solves that counted as failed, of 10", late, "10")


def wild_arguments(robot: Robot, settings: Any) -> Iterator[Row]:
    controller, raised = CartesianController(robot, settings), 0
    huge = 10**400  # A time that no float can represent.
    poses = {"left": [[1], [2, 3]], "nobody": 3}
    arguments: list[Any] = [({}, huge), ({}, float("nan")), ({}, "soon"), (poses, _DT), ({}, _DT, [[0.0], [0.0, 1.0]])]
    for given in arguments:
        try:
            controller.step(*given)
        except Exception:
            raised += 1
    yield Row("arguments that are no numbers, times or poses", "exceptions", raised, "0")


def pushing_solver(robot: Robot, settings: Any) -> Iterator[Row]:
    for promise in (None, _TOOL_SPEED):
        given = settings.model_copy(update={"tool_speed_limit": promise})
        controller, fastest = CartesianController(robot, given, solver=PushingSolver(150)), 0.0
        data = robot.model.createData()
        for _ in range(900):
            reference = controller.step({}, _DT)
            pin.forwardKinematics(robot.model, data, reference.q, reference.v)
            for arm in robot.arms.values():
                speed = pin.getFrameVelocity(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED).linear
                fastest = max(fastest, float(np.linalg.norm(speed)))
        wanted = "no promise" if promise is None else f"{promise:g}"
        yield Row("a solver that drives all joints at full speed", "tool speed [m/s]", fastest, wanted)


class _Ball:
    """A ball that flies straight at a constant speed. Coal measures its distance from the arms."""

    def __init__(self, robot: Robot, start: Array, velocity: Array) -> None:
        self._robot, self._start, self._velocity = robot, start, velocity
        self._geometry = robot.collision_model.copy()
        self._geometry.removeAllCollisionPairs()
        ball = self._geometry.addGeometryObject(pin.GeometryObject("ball", 0, pin.SE3.Identity(), coal.Sphere(_BALL)))
        self._bodies = [i for i in range(ball) if self._geometry.geometryObjects[i].parentJoint]
        for body in self._bodies:
            self._geometry.addCollisionPair(pin.CollisionPair(body, ball))
        self._data, self._distances = robot.model.createData(), self._geometry.createData()

    @property
    def report(self) -> MovingObstacle:
        speed = float(np.linalg.norm(self._velocity))
        return MovingObstacle(shape="sphere", size=(_BALL,), position=tuple(self._start.tolist()), speed=speed)

    def from_moving_bodies(self, q: Array, v: Array, t: float) -> float:
        """Return the distance of the ball at ``t`` [s] from the nearest moving body of an arm [m]."""
        joints = [self._geometry.geometryObjects[body].parentJoint for body in self._bodies]
        moves = [
            any(abs(v[self._robot.model.joints[i].idx_v]) > 1e-3 for i in list(self._robot.model.supports[joint])[1:])
            for joint in joints
        ]
        self._geometry.geometryObjects[-1].placement = pin.SE3(np.eye(3), self._start + t * self._velocity)
        pin.computeDistances(self._robot.model, self._data, self._geometry, self._distances, q)
        found = [
            result.min_distance for result, moving in zip(self._distances.distanceResults, moves, strict=True) if moving
        ]
        return min(found, default=np.inf)


def stalls(robot: Robot, settings: Any, config: Any) -> Iterator[Row]:
    """Report a moving ball only once. The ball flies to a swinging arm, while the loop stalls in one of 40 ticks."""
    controller = CartesianController(robot, settings.model_copy(update={"moving_obstacles": ("hand",)}))
    drive, watch = make_drive(CommandMode.POSITION, robot, config), watch_settings(config.supervision, False)
    loop = ControlLoop(controller, drive, _LOOP_DT, StreamSettings(), watch, owns_plant=True)
    home, across = controller.tool_pose("left"), np.array([0.0, 1.0, 0.0])
    ball = _Ball(robot, home.translation + 1.2 * across, -0.3 * across)
    state, now, tick, uncounted, nearest, moved = (
        _state(robot.home, np.zeros(robot.model.nv), 0.0),
        0.0,
        0,
        0.0,
        np.inf,
        0,
    )
    controller.move_obstacle("hand", ball.report)
    loop.activate(state, now)
    while now < 4.0:
        tick += 1
        now += _LOOP_DT + (0.06 if tick % 40 == 0 else 0.0)
        loop.observe(state, now, _LOOP_DT)
        target = pin.SE3(home.rotation, home.translation + 0.15 * np.sin(3.0 * now) * across)
        step = loop.step(state, {"left": target}, now, _LOOP_DT, {}, {})
        if step.reference is not None:
            state = _state(step.reference.q, step.reference.v, now)
        uncounted = max(uncounted, now - controller.obstacle_reports["hand"].age)
        nearest = min(nearest, ball.from_moving_bodies(state.q, state.v, now))
        moved += bool(np.abs(state.v).max() > 1e-3)
    yield Row(
        "stalls of 60 ms in one of 40 ticks, for 4 s", "age of a report that does not count [s]", uncounted, "one tick"
    )
    yield Row("", "distance of a moving arm from the body [mm]", 1e3 * nearest, f">= {1e3 * settings.min_distance:g}")
    yield Row("", "ticks in which arms moved", moved, "")


def _state(q: Array, v: Array, now: float) -> RobotState:
    return RobotState(q, v, np.zeros(len(q)), None, now)


def main(json: Json = False) -> None:
    """Attack the controller of the dual-arm cell, and print what each attack reached."""
    config: Any = load_config(DEMO_CONFIG)
    robot, settings = Robot.from_config(config), config.control.timed(realtime=False)
    rows: list[Row] = []
    for attack in (writing_solver, wild_arguments, pushing_solver):
        print_progress(attack.__name__.replace("_", " "))
        rows += attack(robot, settings)
    rows += blocking_solver(robot, config.control)
    rows += stalls(robot, settings, config)
    table = figure_table(
        "Attacks on the controller",
        ("attack", "figure", "reached", "allowed"),
        [(r.attack, r.figure, r.reached, r.allowed) for r in rows],
        (),
    )
    print_report({"attacks": [asdict(row) for row in rows]}, (table,), json)


if __name__ == "__main__":
    typer.run(main)
