"""Constant targets that the arms cannot reach, or get in each other's way at: do they come to rest, and how smoothly?

Each tool is asked for a place drawn at random, near where both work or on the other arm's side, until the end. Most of
these cannot be reached with every distance kept: the arms slide along each other, for seconds, until they rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.motion_run import own_controller
from q2r2_control.benchmark.timed_run import Poses, rest_acceleration
from q2r2_control.config.cell import Config
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

RUNS = 50  # of each kind
DURATION = 30.0  # [s]
DT = 0.001  # [s]
AT_REST = 0.1  # RMS of the acceleration over the last 0.5 s, norm over the joints [rad/s^2]
STARTED = 2.0  # when a slide has begun, and what the targets' jump did is over [s]
JOLT = 5.0  # change of a joint's acceleration from one tick to the next [rad/s^2]

# From the middle between both tools at home, for the left tool; of the right one the second is the other way [m].
KINDS: dict[str, tuple[Array, Array]] = {
    "anywhere": (np.array([-0.25, -0.35, -0.3]), np.array([0.25, 0.35, 0.3])),
    "other side": (np.array([-0.2, -0.35, -0.15]), np.array([0.2, 0.0, 0.3])),
}
_TURN = 0.4  # standard deviation of each component of the rotation from home [rad]


@dataclass(frozen=True, slots=True)
class RestFigures:
    """All runs of one kind."""

    kind: str
    runs: int
    at_rest: int  # of these, at the end
    median_acceleration: float  # RMS over the last 0.5 s, norm over the joints [rad/s^2]
    worst_acceleration: float
    jolts: float  # ticks from STARTED on in which a joint's acceleration changes by more than JOLT, in a run
    most_jolts: int
    fallback_ticks: int  # of all runs


@dataclass(frozen=True, slots=True)
class RestReport:
    """What ``q2r2 bench --rest`` found."""

    cell: str
    seed: int
    figures: list[RestFigures]

    def as_json(self) -> dict[str, Any]:
        """For ``--json``."""
        return {"cell": self.cell, "seed": self.seed, "kinds": [asdict(each) for each in self.figures]}


def run_rest(
    config: Config, seed: int, progress: Callable[[str], None] = lambda _: None, runs: int = RUNS
) -> RestReport:
    """Ask for ``runs`` pairs of targets of each kind; the same ones for the same ``seed``."""
    robot = Robot.from_config(config)
    controller = own_controller(robot, config)
    figures = []
    for number, kind in enumerate(KINDS):
        random = np.random.default_rng((seed, number))
        progress(f"{kind}: {runs} pairs of targets, {DURATION:g} s each")
        rest, jolts, fallbacks = np.empty(runs), np.empty(runs, dtype=np.int64), 0
        for run in range(runs):
            v = np.empty((round(DURATION / DT), robot.model.nv))
            targets = draw_targets(robot, kind, random)
            controller.reset(robot.home)
            for tick in range(len(v)):
                v[tick] = controller.step(targets, DT)[1]
            rest[run], jolts[run] = rest_acceleration(v, DT), count_jolts(v, DT)
            fallbacks += controller.fallbacks
        figures.append(
            RestFigures(
                kind=kind,
                runs=runs,
                at_rest=int((rest < AT_REST).sum()),
                median_acceleration=float(np.median(rest)),
                worst_acceleration=float(rest.max()),
                jolts=float(jolts.mean()),
                most_jolts=int(jolts.max()),
                fallback_ticks=fallbacks,
            )
        )
    return RestReport(config.name, seed, figures)


def draw_targets(robot: Robot, kind: str, random: np.random.Generator) -> Poses:
    """A pose for each tool, turned a little from how it is at home."""
    home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    middle = np.mean([pose.translation for pose in home.values()], axis=0)
    targets = {}
    for arm, pose in home.items():
        place = random.uniform(*KINDS[kind])
        if arm != "left":
            place[1] *= -1.0
        targets[arm] = pin.SE3(pin.exp3(_TURN * random.normal(size=3)) @ pose.rotation, middle + place)
    return targets


def count_jolts(v: Array, dt: float) -> int:
    """Ticks from :data:`STARTED` on after which a joint's acceleration is another by :data:`JOLT`; ``v`` is (n, nv)."""
    a = np.diff(v, axis=0, prepend=0.0) / dt
    changes = np.abs(np.diff(a, axis=0)).max(axis=1)
    return int((changes[round(STARTED / dt) :] > JOLT).sum())
