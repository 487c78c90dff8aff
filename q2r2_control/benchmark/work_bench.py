"""Two-armed work motions with our controller and with peers, in one process, on the same cell and limits.

Beside each motion stands what our controller makes of it in free air, where nothing is watched: what is worse than
that, the pairs cost. Peers run open loop as ours does, with targets ahead of time by what they would lag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from q2r2_control.benchmark.motion_run import DT, PATIENCE, MotionFigures, own_controller, run_motion, without_pairs
from q2r2_control.benchmark.peers.base import BenchController, PeerSettings, build_peers
from q2r2_control.benchmark.peers.leading import Leading
from q2r2_control.benchmark.work_motions import WorkMotion
from q2r2_control.config.cell import Config
from q2r2_control.robot.robot import Robot

WORK_PEERS = ("roboplan", "roboplan, 10 nearest", "mink")
FREE_AIR = "free air"


@dataclass(frozen=True, slots=True)
class WorkRow:
    """One motion: our controller in free air, ours, and the peers."""

    motion: str
    about: str
    reachable: bool  # whether both arms can be at all targets with every distance kept
    free_air: MotionFigures
    figures: list[MotionFigures]  # ours first


@dataclass(frozen=True, slots=True)
class WorkReport:
    """All motions on one cell."""

    cell: str
    pairs: int
    rows: list[WorkRow]
    notes: list[str]  # limitations of the peers, and which are not installed

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``."""
        return asdict(self)


def run_work_bench(
    config: Config,
    motions: Sequence[WorkMotion],
    peers: Sequence[str] = WORK_PEERS,
    progress: Callable[[str], None] = lambda what: None,
) -> WorkReport:
    """Run ``motions``, which are made for ``config/dual_iiwa7.yaml``, with ours and with ``peers`` where installed."""
    robot = Robot.from_config(config)
    free = own_controller(without_pairs(config), config, FREE_AIR)
    others, notes = build_peers(peers, PeerSettings(robot, config, DT))
    ahead = [Leading(peer, config.control.position_gain) for peer in others]
    controllers: list[BenchController] = [free, own_controller(robot, config), *ahead]
    rows = []
    for number, motion in enumerate(motions, 1):
        figures = []
        for controller in controllers:
            progress(f"{motion.name} ({number} of {len(motions)}), {controller.name}")
            figures.append(run_motion(controller, robot, motion, PATIENCE))
        rows.append(WorkRow(motion.name, motion.about, motion.reachable, figures[0], figures[1:]))
    return WorkReport(config.name, len(robot.collision_model.collisionPairs), rows, notes)
