"""Times of one full tick of the controller, and of peers for the same motions, measured in turns.

All controllers get the same cell (URDF, limits, margins, pairs), the same targets, ticks of 1 ms and start, and run
open loop on a configuration of their own. The machine's speed varies over time, so a peer is compared with our run
just before its own. The limitations of each peer stand in its module and are printed as notes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.peers.base import PEERS, BenchController, PeerSettings, build_peers
from q2r2_control.benchmark.timed_run import OwnController, Poses, RunMetrics, Targets, TimedRun, metrics_of, timed_run
from q2r2_control.config.cell import Config
from q2r2_control.config.control import ControllerSettings, DistanceSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot

_DT = 0.001  # [s]
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class BenchRow:
    """One controller in one scenario; times of a tick alone, over all rounds."""

    name: str  # of the scenario
    controller: str
    ticks: int  # timed, of a round
    rounds: int
    median_us: float
    p99_us: float
    max_us: float
    median_ratio: float | None  # to our run just before, median over the rounds; None: our own row
    p99_ratio: float | None
    metrics: RunMetrics  # of the last round
    fallback_ticks: int | None  # of the last round; None: a peer has none


@dataclass(frozen=True, slots=True)
class BenchReport:
    """All scenarios and controllers on one cell."""

    cell: str
    pairs: int
    rows: list[BenchRow]
    notes: list[str]  # limitations of the peers, and which are not installed

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``; each row holds its metrics beside the times."""
        data = asdict(self)
        data["rows"] = [row | row.pop("metrics") for row in data["rows"]]
        return data


def run_bench(
    config: Config,
    ticks: int,
    peers: Sequence[str] = tuple(PEERS),
    progress: Callable[[str], None] = lambda what: None,
) -> BenchReport:
    """Time ``ticks`` ticks of 1 ms of each scenario, for our controller and those of ``peers`` that are installed."""
    robot = Robot.from_config(config)
    # Without a time limit, so that a slow machine computes the same motion; with one distance for all pairs, since the
    # peers take no more.
    only_one = {"distances": DistanceSettings(), "pairs": ()}
    settings = config.control.model_copy(update={"solve_time_limit": None, **only_one})
    ours = OwnController(CartesianController(robot, settings))
    others, notes = build_peers(peers, PeerSettings(robot, config, _DT))
    bench = _Bench(robot, settings, ours, others, ticks, progress)
    rows = [row for name, targets in SCENARIOS.items() for row in bench.rows(name, targets)]
    return BenchReport(config.name, len(robot.collision_model.collisionPairs), rows, notes)


class _Bench:
    """Runs our controller and each peer in turns."""

    def __init__(
        self,
        robot: Robot,
        settings: ControllerSettings,
        own: OwnController,
        peers: Sequence[BenchController],
        ticks: int,
        progress: Callable[[str], None],
    ) -> None:
        self._robot, self._settings, self._own, self._peers = robot, settings, own, peers
        self._ticks, self._progress = ticks, progress

    def rows(self, scenario: str, targets: Targets) -> list[BenchRow]:
        """One row for our controller and one for each peer."""
        own_runs: list[TimedRun] = []
        pairs: dict[str, list[tuple[TimedRun, TimedRun]]] = {peer.name: [] for peer in self._peers}
        for turn in range(_ROUNDS):
            for peer in self._peers:
                self._progress(f"{scenario}, {peer.name}, round {turn + 1} of {_ROUNDS}")
                own_runs.append(self._run(self._own, targets))
                pairs[peer.name].append((own_runs[-1], self._run(peer, targets)))
            if not self._peers:
                own_runs.append(self._run(self._own, targets))
        rows = [self._row(scenario, self._own.name, own_runs, None, self._own.fallbacks)]
        for name, runs in pairs.items():
            rows.append(self._row(scenario, name, [run for _, run in runs], [before for before, _ in runs], None))
        return rows

    def _run(self, controller: BenchController, targets: Targets) -> TimedRun:
        return timed_run(controller, self._robot, targets, self._ticks, _DT)

    def _row(
        self,
        scenario: str,
        name: str,
        runs: Sequence[TimedRun],
        before: Sequence[TimedRun] | None,
        fallbacks: int | None,
    ) -> BenchRow:
        times = np.concatenate([run.times_us for run in runs])
        return BenchRow(
            name=scenario,
            controller=name,
            ticks=len(runs[0].times_us),
            rounds=len(runs),
            median_us=float(np.median(times)),
            p99_us=float(np.percentile(times, 99)),
            max_us=float(times.max()),
            median_ratio=_ratio(runs, before, 50.0),
            p99_ratio=_ratio(runs, before, 99.0),
            metrics=metrics_of(runs[-1], self._robot, self._settings),
            fallback_ticks=fallbacks,
        )


def _ratio(runs: Sequence[TimedRun], before: Sequence[TimedRun] | None, percentile: float) -> float | None:
    """Median over the rounds of a percentile of the times over that of the run just before."""
    if before is None:
        return None
    both = zip(runs, before, strict=True)
    return float(
        np.median([np.percentile(a.times_us, percentile) / np.percentile(b.times_us, percentile) for a, b in both])
    )


def _circle(t: float, start: Poses) -> Poses:
    """Circles of 0.1 m radius in free space, 0.5 Hz."""
    phase = np.pi * t
    by = np.array([0.0, 0.1 * np.sin(phase), 0.1 * (1.0 - np.cos(phase))])
    return {arm: pin.SE3(pose.rotation, pose.translation + by) for arm, pose in start.items()}


def _crossing(t: float, start: Poses) -> Poses:
    """The target of each tool is where another one started: the arms block each other."""
    arms = list(start)
    return {arm: start[other] for arm, other in zip(arms, arms[1:] + arms[:1], strict=True)}


SCENARIOS: dict[str, Targets] = {"free motion": _circle, "contact": _crossing}
