"""Measure joints, loads and stops in a commissioning, while the arms move slowly. Each result has a stated bound."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.errors import PlantError
from q2r2_control.pipeline.slow_run import Moment, SlowRun, resting
from q2r2_control.robot.load import LEAST_POSTURES, MODEL, PENDANT, LoadReport, identify_load
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_STEP = np.radians(1.17)  # Commanded step of a joint [rad]. With an error of 0.17 degrees, a degree of motion is left.
# Largest difference between a measured joint and the commanded joint, at rest and during the motion [deg].
_REACHED, _BEHIND = 0.2, 0.8
# Largest displacements of A1 .. A7 from the first posture [rad]. A1 does not move, because its angle changes no torque.
_SPREAD = np.array([0.0, 0.1, 0.2, 0.25, 0.4, 0.5, 0.5])
_TRIES = 40
LED = 2.0  # Time of the upward motion before the hand releases its button [s].
# Longest time from the release of the hand's button until the arm brakes: the timeout of a silent hand [s].
_LATENCY = 0.15
LEAST_SPEED = 0.01  # If a tool is slower than this, its stop is not measured [m/s].
_STANDS = 1e-3  # Joints nearer than this to their final positions count as resting [rad].


@dataclass(frozen=True, slots=True)
class JointMotion:
    """The motion of a joint that was commanded to move by one degree and back."""

    joint: str
    commanded_deg: float  # Commanded motion away from the first posture.
    measured_deg: float  # Measured motion away from the first posture.
    behind_deg: float  # Largest lag of the joint behind its reference, during the motion.
    others_deg: float  # Largest motion of another joint.

    def check(self) -> JointMotion:
        """Return this report. Raises :class:`PlantError` if the joint did not follow, or if another joint moved."""
        off = abs(self.measured_deg - self.commanded_deg)
        if off > _REACHED or self.behind_deg > _BEHIND or self.others_deg > _REACHED:
            raise PlantError(
                f"{self.joint}: commanded {self.commanded_deg:.2f} deg, measured {self.measured_deg:.2f}, "
                f"{self.behind_deg:.2f} behind on the way, other joints moved by {self.others_deg:.2f}; allowed: off "
                f"by {_REACHED:g}, {_BEHIND:g} behind, others {_REACHED:g}; see to its brake, and to swapped joints"
            )
        return self


def measure_joint(run: SlowRun, joint: int) -> JointMotion:
    """Move a joint by a degree towards the middle of its range and back, and check the motion.

    ``joint`` is an index of ``Robot.joint_names``. Raises :class:`PlantError` if the path is not free, or if the check
    fails.
    """
    robot, start = run.robot, run.reference
    goal = start.copy()
    middle = 0.5 * (robot.position_lower + robot.position_upper)[joint]
    goal[joint] += _STEP if goal[joint] < middle else -_STEP
    there = run.lead_to(goal)
    back = None if there is None else run.lead_to(start)
    if there is None or back is None:
        raise PlantError(f"{robot.joint_names[joint]}: no room for a degree; begin where the arms are far apart")
    moments = [*there, *back]
    q, reference = (np.degrees([getattr(moment, name) for moment in moments]) for name in ("q", "reference"))
    end = len(there) - 1
    others = np.delete(np.ptp(q, axis=0), joint)
    return JointMotion(
        joint=robot.joint_names[joint],
        commanded_deg=float(reference[end, joint] - reference[0, joint]),
        measured_deg=float(q[end, joint] - q[0, joint]),
        behind_deg=float(np.abs(reference - q)[:, joint].max()),
        others_deg=float(others.max()),
    ).check()


class LoadSurvey:
    """Moves all arms through postures near their first posture, and finds the load that each arm carries."""

    def __init__(self, run: SlowRun) -> None:
        self._run, self._start = run, run.reference
        self._goals = _postures(run.robot, self._start)
        self._rests: list[Array] = []  # For each rest (3, nv): posture [rad], torque and external torque [Nm].

    def measure(self) -> list[LoadReport] | None:
        """Return each arm's load, compared with the loads in the model and on the pendant.

        Return None if the cabinets measure no torques. After a :class:`PlantError`, another call continues with
        the next posture.
        """
        while len(self._rests) < LEAST_POSTURES:
            if (goal := next(self._goals, None)) is None:
                free = f"{len(self._rests)} postures are free; allowed: {LEAST_POSTURES}"
                raise PlantError(f"{free}; begin where the arms are far apart")
            if (moments := self._run.lead_to(goal)) is not None:
                rows = [(moment.q, moment.tau, moment.external) for moment in resting(moments)]
                self._rests.append(np.mean(rows, axis=0))
        self._run.lead_to(self._start)
        robot, data = self._run.robot, self._run.robot.model.createData()
        q, tau, external = np.array(self._rests).transpose(1, 0, 2)
        if not tau.any():
            return None
        unexplained = tau - [pin.computeGeneralizedGravity(robot.model, data, posture).copy() for posture in q]
        return [
            identify_load(robot, arm, q, missing, against)
            for arm in robot.arms
            for against, missing in ((MODEL, unexplained), (PENDANT, external))
            if np.isfinite(missing).all()
        ]


def _postures(robot: Robot, start: Array) -> Iterator[Array]:
    """Yield random postures (nv,) [rad] near ``start``, which are the same in each run."""
    random = np.random.default_rng(0)
    for _ in range(_TRIES):
        goal = start.copy()
        for arm in robot.arms.values():
            goal[arm.joints] += random.uniform(-_SPREAD, _SPREAD)
        yield goal


@dataclass(frozen=True, slots=True)
class StopReport:
    """The stop of an arm after its hand has released the button, or after the program was killed."""

    arm: str
    cause: str
    tool_speed_mm_s: float  # Speed of the tool when the stop began.
    stopped_mm: float  # Measured distance of the tool from the beginning of the stop to rest.
    allowed_mm: float  # Distance of the certified stop, plus the motion during the latency.
    stopped_s: float  # Measured duration of the stop.
    allowed_s: float

    def check(self) -> StopReport:
        """Return this report. Raises :class:`PlantError` if the stop was too long or too late."""
        if self.tool_speed_mm_s < 1e3 * LEAST_SPEED:
            raise PlantError(f"the {self.arm} arm did not go up; begin where its tool has 100 mm of room above it")
        if self.stopped_mm > self.allowed_mm or self.stopped_s > self.allowed_s:
            raise PlantError(
                f"the {self.arm} arm, {self.cause}, stopped after {self.stopped_mm:.1f} mm and {self.stopped_s:.2f} s; "
                f"allowed: {self.allowed_mm:.1f} mm and {self.allowed_s:.2f} s; see to the network's and this "
                "computer's latency"
            )
        return self


def measure_stop(run: SlowRun, arm: str) -> StopReport:
    """Let a simulated hand move ``arm`` upwards and release its button, as an operator would, and check the stop."""
    return let_go_report(run.robot, arm, run.let_go([arm], LED)).check()


def let_go_report(robot: Robot, arm: str, moments: list[Moment]) -> StopReport:
    """Return the report on a stop.

    In ``moments``, a hand moves ``arm`` and releases its button, and the arm comes to rest.
    """
    led = [index for index, moment in enumerate(moments) if moment.engaged[arm]]
    if not led:
        raise PlantError(f"the {arm} arm did not follow the hand")
    rest, released = moments[-1].q, moments[min(led[-1] + 1, len(moments) - 1)]
    joints = robot.arms[arm].joints
    moving = [moment.now for moment in moments[led[-1] + 1 :] if np.abs(moment.q - rest)[joints].max() > _STANDS]
    took = max(moving, default=released.now) - released.now
    return stop_report(robot, arm, "let go", moments[led[-1]], released.q, rest, took)


def stop_report(
    robot: Robot, arm: str, cause: str, last: Moment, released: Array, rest: Array, took: float
) -> StopReport:
    """Return the report on the stop of an arm.

    Args:
        robot: The robot.
        arm: The arm.
        cause: Why the arm stopped, in words.
        last: The last moment in which the arm followed its hand.
        released: Measured joints when the arm began to stop (nv,) [rad].
        rest: Measured joints after the stop (nv,) [rad].
        took: Duration of the stop [s].
    """
    v = np.where(np.isin(np.arange(len(rest)), robot.arms[arm].joints), last.v, 0.0)
    deceleration = np.full_like(v, np.inf) if last.deceleration is None else np.maximum(last.deceleration, 1e-6)
    brakes = np.abs(v) / deceleration
    travel = v * (_LATENCY + 0.5 * brakes)
    here, end, furthest = (robot.tool_pose(q, arm).translation for q in (released, rest, released + travel))
    return StopReport(
        arm=arm,
        cause=cause,
        tool_speed_mm_s=1e3 * tool_speed(robot, arm, last),
        stopped_mm=float(1e3 * np.linalg.norm(end - here)),
        allowed_mm=float(1e3 * np.linalg.norm(furthest - here)),
        stopped_s=took,
        allowed_s=float(brakes.max()) + _LATENCY,
    )


def tool_speed(robot: Robot, arm: str, moment: Moment) -> float:
    """Return the speed of the arm's tool in the reference during the next 10 ms [m/s]."""
    at, ahead = (robot.tool_pose(q, arm).translation for q in (moment.reference, moment.reference + 0.01 * moment.v))
    return float(100.0 * np.linalg.norm(ahead - at))
