"""How well do two arms work when hand samples drive them through the whole stack, to arms in MuJoCo?

Everything is as in ``q2r2 run``, but time is simulated, and the cell has no loose objects, because the motions do not
consider them. An error is the distance between the measured tool and the position that the hand asks for at the same
time. It includes the delays of samples, filter, loop and arm. Each motion also runs with the same samples in free air,
where no pair is monitored. The difference between both runs is the cost of the monitored pairs.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field, replace
from typing import Annotated

import mujoco
import numpy as np
import typer

from q2r2_control.benchmark.motion_run import arrival_time, nearest_pair, without_pairs
from q2r2_control.benchmark.work_motions import ARMS, WORK_MOTIONS, WorkMotion, motions_named
from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import PlantError
from q2r2_control.events import Event
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.arm_states import AT_REST
from q2r2_control.types import Array, CommandMode
from q2r2_control.verification.contract import Contract
from q2r2_control.viewer.tables import record_table
from q2r2_control.wording import sentence
from work_hands import MOTION_BEGINS_S, WorkHands

_TAIL_S = 0.5  # Duration of the end of a motion in which the arms should rest [s].
_TIME_ROUNDING_S = 1e-9  # Largest rounding error of a tick's time [s].
_TICKS_PER_MARGIN = 4  # The margins of all pairs are measured once in this number of ticks.


@dataclass(frozen=True, slots=True)
class StackFigures:
    """The figures of one motion. All except the last four are measured from the end of the approach on."""

    mode: str
    motion: str
    done: float  # Share of the planned ticks that ran; 1 unless the run was stopped.
    rms_error_mm: float | None = None  # RMS error of the tool with the larger error, until the hands rest.
    max_error_mm: float | None = None  # Largest error of either tool, until the hands rest.
    path_error_mm: float | None = None  # RMS error from the pose that the hand asked for one filter delay earlier.
    end_error_mm: float | None = None  # Largest error of either tool at the end.
    # Time from the end of the approach until both tools stay within 10 mm of the goal. None if they do not stay
    # there, or if the motion has no goal.
    arrival_s: float | None = None
    fallback_percent: float | None = None  # Percentage of ticks in which the certified stop was executed.
    measured_distance_mm: float | None = None  # Least distance of a monitored pair at measured postures, from Coal.
    measured_pair: tuple[str, str] | None = None  # The pair with measured_distance_mm.
    measured_margin_mm: float | None = None  # Least difference between a pair's measured and kept distance.
    reference_distance_mm: float | None = None  # Least distance of a monitored pair at the reference's postures.
    max_acceleration_ratio: float | None = None  # Largest acceleration of the reference, divided by the joint's limit.
    max_torque_ratio: float | None = None  # Largest motor torque, divided by the limit at which the motor saturates.
    # RMS, over the last 0.5 s, of the norm of the accelerations of all joints in the reference [rad/s^2].
    rest_acceleration: float | None = None
    slip_mm: float = 0.0  # Largest distance by which the leash moved a target.
    pauses: list[str] = field(default_factory=list)  # Reasons why an arm was paused during the run.
    stopped: str | None = None  # Reason why the run was stopped early; None if it was not stopped early.
    broken: dict[str, int] = field(default_factory=dict)  # Number of ticks that broke each promise of the controller.

    @property
    def passed(self) -> bool:
        """Return whether the motion reached its end, without a pause and with every promise kept at every tick."""
        return not (self.broken or self.pauses or self.stopped)


class Stack:
    """A cell in MuJoCo. Hands move its arms through one work motion after another, in one command ``mode``.

    If ``free`` is True, no pair is monitored, and all bodies pass through each other.
    """

    def __init__(self, config: Config, mode: CommandMode | str, free: bool = False) -> None:
        bare = config.mujoco.model_copy(update={"objects": {}})
        self._config = config.model_copy(update={"mujoco": bare})
        whole = Robot.from_config(self._config)
        plant = MujocoPlant(whole, self._config)
        if free:
            plant.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.robot = without_pairs(self._config) if free else whole
        self._start = {arm: whole.tool_pose(whole.home, arm) for arm in whole.arms}
        self._plant, self.mode, self.free = plant, CommandMode(mode), free
        self._kept = kept_distances(self.robot, self._config.control).values

    def run(self, motion: WorkMotion, seed: int | None = 0) -> StackFigures:
        """Run ``motion`` from home. ``seed`` decides the noise of the samples; if it is None, the samples are exact."""
        hands = WorkHands(motion, self._start, self._config.teleop, seed)
        pipeline = Pipeline(self._config, self.robot, hands, self._plant, self.mode)
        log = _Log(pipeline, checked=len(self._kept) > 0)
        ends = MOTION_BEGINS_S + motion.ends
        try:
            summary = pipeline.run(ends, realtime=False)
        except PlantError as fault:
            done = min(log.t[-1] / ends, 1.0)
            return StackFigures(str(self.mode), motion.name, done, stopped=str(fault), broken=log.broken)
        figures = StackFigures(
            motion=motion.name,
            mode=str(self.mode),
            done=1.0,
            slip_mm=max(arm.slip_mm_max for arm in summary.arms.values()),
            pauses=[f"{event.arm}: {sentence(event.reason)}" for event in summary.events if _pauses(event)],
            broken=log.broken,
        )
        log.cut(MOTION_BEGINS_S + motion.begins, ends)
        errors, late, to_goal = _errors(log, hands, pipeline.teleop.delay, ends)
        moving = np.array(log.t) <= MOTION_BEGINS_S + motion.rests
        return replace(
            self._with_distances(self._with_efforts(figures, log), log),
            rms_error_mm=_rms_mm(errors[moving]),
            max_error_mm=1e3 * float(errors[moving].max()),
            path_error_mm=_rms_mm(late[moving]),
            end_error_mm=1e3 * float(errors[-1].max()),
            arrival_s=arrival_time(to_goal, 1.0 / self._config.nominal_rate_hz) if motion.has_goal else None,
        )

    def _with_efforts(self, figures: StackFigures, log: _Log) -> StackFigures:
        a, tau = np.array(log.a), np.array(log.tau)
        limit = self.robot.capped_acceleration(self._config.control.acceleration_limit)
        tail = a[-round(_TAIL_S * self._config.nominal_rate_hz) :]
        return replace(
            figures,
            fallback_percent=100.0 * float(np.mean(log.fallback)),
            max_acceleration_ratio=float((np.abs(a) / limit).max()),
            max_torque_ratio=float((np.abs(tau) / self.robot.torque_limit).max()),
            rest_acceleration=float(np.sqrt(np.mean(np.sum(tail**2, axis=1)))),
        )

    def _with_distances(self, figures: StackFigures, log: _Log) -> StackFigures:
        if not len(self._kept):
            return figures
        measured, reference = np.array(log.measured), np.array(log.reference)
        distance, pair = nearest_pair(measured, self.robot)
        margins = [(self.robot.distance_values(q) - self._kept).min() for q in measured[::_TICKS_PER_MARGIN]]
        return replace(
            figures,
            measured_distance_mm=distance,
            measured_pair=pair,
            measured_margin_mm=1e3 * float(min(margins)),
            reference_distance_mm=nearest_pair(reference, self.robot)[0],
        )


class _Log:
    """A listener that stores the data for the figures. If ``checked`` is True, it checks the contract at every tick."""

    def __init__(self, pipeline: Pipeline, checked: bool) -> None:
        self._pipeline, self._checked = pipeline, checked
        self._contract: Contract | None = None
        self.t: list[float] = []  # Time since the start of the run [s].
        self.measured: list[Array] = []  # Measured joint positions (nv,) [rad].
        self.reference: list[Array] = []  # Joint positions of the reference (nv,) [rad].
        self.a: list[Array] = []  # Accelerations of the reference (nv,) [rad/s^2].
        self.tau: list[Array] = []  # Torques of the motors (nv,) [Nm].
        self.tools: list[Array] = []  # Measured tool positions (arms, 3) [m].
        self.fallback: list[bool] = []  # True if the certified stop was executed.
        pipeline.listeners.append(self)

    def __call__(self, tick: Tick) -> None:
        if self._checked:
            # The contract is made at the first tick, because the pipeline may replace its controller when a run begins.
            self._contract = self._contract or Contract(self._pipeline.controller)
            self._contract.observe(tick.reference, tick.step)
        self.t.append(tick.t)
        self.measured.append(tick.state.q)
        self.reference.append(tick.reference.q)
        self.a.append(tick.reference.a)
        self.tau.append(tick.state.tau)
        self.tools.append(np.array([tick.tools[arm].translation for arm in ARMS]))
        self.fallback.append(tick.reference.report.fallback)

    @property
    def broken(self) -> dict[str, int]:
        """Return the promises that the controller broke, with the number of ticks in which it broke each promise."""
        margins = self._contract.margins.values() if self._contract is not None else ()
        return {margin.name: margin.violations for margin in margins if margin.violations}

    def cut(self, begin: float, end: float) -> None:
        """Keep only the ticks after ``begin`` and up to ``end`` [s]."""
        first, last = (bisect_right(self.t, time + _TIME_ROUNDING_S) for time in (begin, end))
        for name in ("t", "measured", "reference", "a", "tau", "tools", "fallback"):
            setattr(self, name, getattr(self, name)[first:last])


def _errors(log: _Log, hands: WorkHands, delay: float, end: float) -> tuple[Array, Array, Array]:
    """Return three arrays (n, arms) with distances of the measured tools from positions that the hands ask for [m].

    The hands ask for these positions at the time of the tick, ``delay`` [s] before the tick, and at the time ``end``
    [s].
    """
    tools = np.array(log.tools)
    asked = (
        [[pose.translation for pose in hands.asked(time).values()] for time in times]
        for times in (log.t, [t - delay for t in log.t], [end])
    )
    now, before, goal = (np.linalg.norm(tools - np.array(places), axis=2) for places in asked)
    return now, before, goal


def _rms_mm(errors: Array) -> float:
    """Return the RMS error of the tool with the larger error [mm], from errors (n, arms) [m]."""
    return 1e3 * float(np.sqrt(np.mean(errors**2, axis=0)).max())


def _pauses(event: Event) -> bool:
    return event.destination in AT_REST and event.source not in AT_REST


def main(
    motion: Annotated[
        list[str] | None, typer.Option(help="Run only this motion, or the motions whose names begin with it.")
    ] = None,
    mode: Annotated[list[CommandMode] | None, typer.Option(help="Command mode of the arms. Repeatable.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of what samples add to the hands' poses.")] = 0,
    json: Json = False,
) -> None:
    """Print how well the tools follow, and at which cost. Exit with 1 if a motion broke a promise or did not end."""
    config = load_config(DEMO_CONFIG)
    modes = mode or [CommandMode.POSITION, CommandMode.TORQUE]
    stacks = [Stack(config, driven, free) for driven in modes for free in (False, True)]
    found: list[StackFigures] = []
    for each in motions_named(motion or WORK_MOTIONS):
        for stack in stacks:
            place = ", free air" if stack.free else ""
            print_progress(f"{each.name}, {stack.mode}{place}")
            figures = stack.run(each, seed)
            found.append(replace(figures, mode=figures.mode + place))
        table = record_table(f"{each.name}: {each.about}", found[-len(stacks) :])
        print_report(None, () if json else (table,), False)
    if json:
        print_report({"cell": config.name, "seed": seed, "motions": found}, (), True)
    raise typer.Exit(0 if all(figures.passed for figures in found) else 1)


if __name__ == "__main__":
    typer.run(main)
