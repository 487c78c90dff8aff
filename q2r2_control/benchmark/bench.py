"""Our controller and peers in the same motions: same cell, limits, targets and ticks, in one process, in turns.

Beside each motion stands what our controller makes of it in free air, where nothing is watched. What is worse than
that, the pairs cost. Peers run open loop as ours does, with targets ahead of time by what they would lag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from q2r2_control.benchmark.motion_run import DT, PATIENCE, MotionFigures, OwnController, run_motion, without_pairs
from q2r2_control.benchmark.peers.base import BenchController, Leading, PeerSettings, build_peers
from q2r2_control.benchmark.work_motions import WorkMotion
from q2r2_control.config.cell import Config
from q2r2_control.robot.robot import Robot

FREE_AIR = "free air"


@dataclass(frozen=True, slots=True)
class BenchRow:
    """One motion: our controller in free air, ours, and the peers."""

    motion: str
    about: str
    reachable: bool  # whether both arms can be at all targets with every distance kept
    free_air: MotionFigures
    figures: list[MotionFigures]  # ours first


@dataclass(frozen=True, slots=True)
class BenchReport:
    """All motions on one cell."""

    cell: str
    pairs: int
    rounds: int
    rows: list[BenchRow]
    notes: list[str]  # limitations of the peers, and which are not installed

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``."""
        return asdict(self)


def run_bench(
    config: Config,
    motions: Sequence[WorkMotion],
    peers: Sequence[str],
    rounds: int = 1,
    progress: Callable[[str], None] = lambda what: None,
) -> BenchReport:
    """Run ``motions``, which are made for ``config/dual_iiwa7.yaml``, with ours and with ``peers`` where installed.

    All controllers take turns, ``rounds`` times, since a machine's speed varies. Figures are those of the last round,
    and times the medians over the rounds.
    """
    robot = Robot.from_config(config)
    free = OwnController(without_pairs(config), config, FREE_AIR)
    others, notes = build_peers(peers, PeerSettings(robot, config, DT))
    ahead = [Leading(peer, config.control.position_gain) for peer in others]
    controllers: list[BenchController] = [free, OwnController(robot, config), *ahead]
    rows = []
    for number, motion in enumerate(motions, 1):
        runs: dict[str, list[MotionFigures]] = {controller.name: [] for controller in controllers}
        for turn in range(rounds):
            for controller in controllers:
                progress(f"{motion.name} ({number} of {len(motions)}), round {turn + 1}, {controller.name}")
                runs[controller.name].append(run_motion(controller, robot, motion, PATIENCE))
        figures = [_over_rounds(found) for found in runs.values()]
        rows.append(BenchRow(motion.name, motion.about, motion.reachable, figures[0], figures[1:]))
    return BenchReport(config.name, len(robot.collision_model.collisionPairs), rounds, rows, notes)


def _over_rounds(runs: Sequence[MotionFigures]) -> MotionFigures:
    times = [run.times_us for run in runs if run.times_us is not None]
    if not times:
        return runs[-1]
    median, p99, longest = np.median(times, axis=0).tolist()
    return replace(runs[-1], times_us=(median, p99, longest))
