"""Do the arms come to rest, and how smoothly, at constant targets that they cannot reach or that bring them together?

Each tool gets a random constant target. In one kind of runs, targets are anywhere in the space that both arms share. In
the other kind, each target is on the other arm's side. Most targets cannot be reached with every distance kept. The
arms then slide along each other for seconds until they rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pinocchio as pin
import typer

from q2r2_control.benchmark.motion_run import JOLT, OwnController, count_jolts, rest_acceleration
from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.viewer.tables import record_table

RUNS_PER_KIND = 50  # Number of runs of each kind.
DURATION_S = 30.0  # Duration of a run [s].
DT = 0.001  # Period of a tick [s].
# Arms count as resting if their acceleration is at most this [rad/s^2]. Their acceleration is the RMS, over the last
# 0.5 s, of the norm of all joints' accelerations.
MAX_REST_ACCELERATION = 0.1
# Jolts are counted after this time [s], when the jump of the targets has no more effect and the arms slide.
JOLTS_COUNT_AFTER_S = 2.0
NOTES = (
    f"Targets stay constant for {DURATION_S:g} s. Most of them cannot be reached with every distance kept.",
    f"at rest: Number of runs that end with an acceleration below {MAX_REST_ACCELERATION:g} rad/s^2.",
    "acceleration: RMS over the last 0.5 s of the norm over the joints [rad/s^2].",
    f"jolts: Number of ticks of a run after {JOLTS_COUNT_AFTER_S:g} s in which a joint's acceleration changes by more "
    f"than {JOLT:g} rad/s^2.",
    "fallback ticks: Number of ticks of all runs in which the certified stop was executed.",
)

# For each kind of runs: the lower and upper bounds of the left tool's target (x, y, z), measured from the middle
# between both tools at home [m]. For the right tool, y has the opposite sign.
KINDS: dict[str, tuple[Array, Array]] = {
    "anywhere": (np.array([-0.25, -0.35, -0.3]), np.array([0.25, 0.35, 0.3])),
    "other side": (np.array([-0.2, -0.35, -0.15]), np.array([0.2, 0.0, 0.3])),
}
# Standard deviation of each component of the rotation vector from the tool's rotation at home to the target [rad].
_ROTATION_DEVIATION = 0.4


@dataclass(frozen=True, slots=True)
class RestFigures:
    """The figures of all runs of one kind."""

    kind: str
    runs: int
    at_rest: int  # Number of runs whose arms rest at the end.
    # The acceleration of a run is the RMS, over the last 0.5 s, of the norm of all joints' accelerations [rad/s^2].
    median_acceleration: float  # Median over the runs [rad/s^2].
    worst_acceleration: float  # Largest acceleration of any run [rad/s^2].
    # Mean number of ticks of a run after JOLTS_COUNT_AFTER_S in which an acceleration changes by more than JOLT.
    jolts: float
    # Largest number of ticks of one run after JOLTS_COUNT_AFTER_S in which an acceleration changes by more than JOLT.
    most_jolts: int
    fallback_ticks: int  # Number of ticks of all runs in which the certified stop was executed.


def run_rest(config: Config, seed: int, runs: int = RUNS_PER_KIND) -> list[RestFigures]:
    """Run with ``runs`` pairs of targets of each kind. The same ``seed`` gives the same targets."""
    robot = Robot.from_config(config)
    controller = OwnController(robot, config)
    figures = []
    for number, kind in enumerate(KINDS):
        random = np.random.default_rng((seed, number))
        print_progress(f"{kind}: {runs} pairs of targets, {DURATION_S:g} s each")
        rest, jolts, fallbacks = np.empty(runs), np.empty(runs, dtype=np.int64), 0
        for run in range(runs):
            v = np.empty((round(DURATION_S / DT), robot.model.nv))
            targets = draw_targets(robot, kind, random)
            controller.reset(robot.home)
            for tick in range(len(v)):
                v[tick] = controller.step(targets, DT)[1]
            rest[run], jolts[run] = rest_acceleration(v, DT), count_jolts(v, DT, JOLTS_COUNT_AFTER_S)
            fallbacks += sum(controller.stopped)
        figures.append(
            RestFigures(
                kind=kind,
                runs=runs,
                at_rest=int((rest < MAX_REST_ACCELERATION).sum()),
                median_acceleration=float(np.median(rest)),
                worst_acceleration=float(rest.max()),
                jolts=float(jolts.mean()),
                most_jolts=int(jolts.max()),
                fallback_ticks=fallbacks,
            )
        )
    return figures


def draw_targets(robot: Robot, kind: str, random: np.random.Generator) -> dict[str, pin.SE3]:
    """Return a random target pose for each tool. The rotation of a target is near the tool's rotation at home."""
    home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    middle = np.mean([pose.translation for pose in home.values()], axis=0)
    targets = {}
    for arm, pose in home.items():
        place = random.uniform(*KINDS[kind])
        if arm != "left":
            place[1] *= -1.0
        targets[arm] = pin.SE3(pin.exp3(_ROTATION_DEVIATION * random.normal(size=3)) @ pose.rotation, middle + place)
    return targets


def main(
    seed: Annotated[int, typer.Option(min=0, help="Seed of the targets.")] = 0,
    runs: Annotated[int, typer.Option(min=1, help="Number of runs for each kind of targets.")] = RUNS_PER_KIND,
    json: Json = False,
) -> None:
    """Move the arms to constant random targets, and print how quiet the arms are at the end."""
    config = load_config(DEMO_CONFIG)
    figures = run_rest(config, seed, runs)
    table = record_table(f"{config.name}: Constant targets, seed {seed}", figures, NOTES)
    print_report({"cell": config.name, "seed": seed, "kinds": figures}, (table,), json)


if __name__ == "__main__":
    typer.run(main)
