"""How long one full tick of the controller takes, and how long peers take for the same motions, in turns.

Everybody gets the same cell (URDF, limits, margins, pairs), the same targets, ticks of 1 ms and start, and runs open
loop on its own configuration. A machine's speed wanders, so that a peer is compared with our run just before its own.
What each peer has no means for stands in its module and is a note of the report.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.peers.base import INSTALL, PEERS, Candidate, Setup, is_installed, make_peer
from q2r2_control.benchmark.timed_run import Deeds, Ours, Poses, Targets, Timed, deeds_of, timed_run
from q2r2_control.config import Config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot

_DT = 0.001  # [s]
_ROUNDS = 3
FEWEST_TICKS = 100


@dataclass(frozen=True, slots=True)
class BenchRow:
    """One controller in one scenario; times of a tick alone, over all rounds."""

    name: str  # of the scenario
    controller: str
    ticks: int  # timed ones of a round
    rounds: int
    median_us: float
    p99_us: float
    max_us: float
    median_ratio: float | None  # over ours just before, the rounds' median; None: this is ours
    p99_ratio: float | None
    deeds: Deeds  # of the last round
    fallback_ticks: int | None  # of the last round; None: a peer has none


@dataclass(frozen=True, slots=True)
class BenchReport:
    """All scenarios and controllers on one cell."""

    cell: str
    pairs: int
    rows: list[BenchRow]
    notes: list[str]  # what peers have no means for, and which are not installed

    def as_json(self) -> dict[str, Any]:
        """Plain data for ``json.dumps``; what was done stands beside the times."""
        plain = asdict(self)
        plain["rows"] = [row | row.pop("deeds") for row in plain["rows"]]
        return plain


def run_bench(
    config: Config,
    ticks: int,
    peers: Sequence[str] = tuple(PEERS),
    progress: Callable[[str], None] = lambda what: None,
) -> BenchReport:
    """Time ``ticks`` ticks of 1 ms of each scenario, ours and those of ``peers`` that are installed.

    Raises :class:`ConfigError` for fewer than 100 ticks.
    """
    if ticks < FEWEST_TICKS:
        raise ConfigError(f"bench: ticks = {ticks}: allowed: {FEWEST_TICKS} or more")
    robot = Robot.from_config(config)
    # What is late depends on the machine that is being measured.
    settings = config.control.model_copy(update={"solve_time_limit": None})
    ours = Ours(CartesianController(robot, settings))
    others, notes = _build(peers, Setup(robot, config, _DT))
    bench = _Bench(robot, settings, ours, others, ticks, progress)
    rows = [row for name, targets in SCENARIOS.items() for row in bench.rows(name, targets)]
    return BenchReport(config.name, len(robot.collision_model.collisionPairs), rows, notes)


def _build(names: Sequence[str], setup: Setup) -> tuple[list[Candidate], list[str]]:
    """The peers that can be built, and a line on each peer."""
    peers: list[Candidate] = []
    notes = []
    for name in names:
        if not is_installed(name):
            notes.append(f"{name}: not installed; {INSTALL}")
            continue
        try:
            peer = make_peer(name, setup)
        except Exception as error:  # whatever a package of another version raises
            notes.append(f"{name}: cannot be built for this cell: {type(error).__name__}: {error}")
            continue
        peers.append(peer)
        notes.append(f"{name}: {peer.cannot}")
    return peers, notes


class _Bench:
    """Runs ours and each peer in turns."""

    def __init__(
        self,
        robot: Robot,
        settings: ControllerSettings,
        ours: Ours,
        peers: Sequence[Candidate],
        ticks: int,
        progress: Callable[[str], None],
    ) -> None:
        self._robot, self._settings, self._ours, self._peers = robot, settings, ours, peers
        self._ticks, self._progress = ticks, progress

    def rows(self, scenario: str, targets: Targets) -> list[BenchRow]:
        """A row for ours and one for each peer."""
        own: list[Timed] = []
        pairs: dict[str, list[tuple[Timed, Timed]]] = {peer.name: [] for peer in self._peers}
        for turn in range(_ROUNDS):
            for peer in self._peers:
                self._progress(f"{scenario}, {peer.name}, round {turn + 1} of {_ROUNDS}")
                own.append(self._run(self._ours, targets))
                pairs[peer.name].append((own[-1], self._run(peer, targets)))
            if not self._peers:
                own.append(self._run(self._ours, targets))
        rows = [self._row(scenario, self._ours.name, own, None, self._ours.fallbacks)]
        for name, runs in pairs.items():
            rows.append(self._row(scenario, name, [run for _, run in runs], [before for before, _ in runs], None))
        return rows

    def _run(self, candidate: Candidate, targets: Targets) -> Timed:
        return timed_run(candidate, self._robot, targets, self._ticks, _DT)

    def _row(
        self, scenario: str, name: str, runs: Sequence[Timed], before: Sequence[Timed] | None, fallbacks: int | None
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
            deeds=deeds_of(runs[-1], self._robot, self._settings),
            fallback_ticks=fallbacks,
        )


def _ratio(runs: Sequence[Timed], before: Sequence[Timed] | None, percentile: float) -> float | None:
    """Median over the rounds of a percentile of the times over that of the run just before."""
    if before is None:
        return None
    both = zip(runs, before, strict=True)
    return float(
        np.median([np.percentile(a.times_us, percentile) / np.percentile(b.times_us, percentile) for a, b in both])
    )


def _circle(t: float, start: Poses) -> Poses:
    """Circles of 0.1 m in the air, one in two seconds."""
    phase = np.pi * t
    by = np.array([0.0, 0.1 * np.sin(phase), 0.1 * (1.0 - np.cos(phase))])
    return {arm: pin.SE3(pose.rotation, pose.translation + by) for arm, pose in start.items()}


def _crossing(t: float, start: Poses) -> Poses:
    """Every tool is asked to be where another one started: the arms press against each other."""
    arms = list(start)
    return {arm: start[other] for arm, other in zip(arms, arms[1:] + arms[:1], strict=True)}


SCENARIOS: dict[str, Targets] = {"free motion": _circle, "contact": _crossing}
