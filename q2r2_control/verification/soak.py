"""A long run of the controller under hostile input. Every promise of its contract is checked at every tick."""

from __future__ import annotations

import gc
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import Solver
from q2r2_control.control.solvers.guard import Guard
from q2r2_control.control.solvers.registry import DAQP, solver_of
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.adversary import HostileChanges, Request
from q2r2_control.verification.contract import Contract, time_of
from q2r2_control.verification.fault_injection import (
    ATTACKS,
    STOPPING_FAULTS,
    FaultySolver,
    Segment,
    WorstSolver,
    segments,
    untimed,
)
from q2r2_control.verification.promises import Margin

COUNTED = {
    "segments": "segments",
    "resets": "resets",
    "solver_faults": "ticks with a failing solver, attacks among them",
    "attacks": "ticks with a solver that works against the arms",
    "fallbacks": "certified stops executed",
    "fallbacks_healthy": "of these with a healthy solver",
    "unsolved": "ticks that a healthy solver left unsolved",
    "openings": "openings of grippers",
    "openings_refused": "of these refused",
    "grasps": "grasps and releases",
    "changes": "changes of settings",
}
_MEASURED_AFTER = (0.1, 0.4, 0.7, 1.0)  # Shares of the ticks after which the memory is measured.
MEMORY_ALLOWED = 5.0  # Allowed growth of the memory [MB].


@dataclass(frozen=True, slots=True)
class Violation:
    """The first violation of a promise, with the request at that tick."""

    promise: str
    seed: int
    tick: int
    segment: str
    since_segment: int  # Number of ticks since the segment began.
    q: Array  # (nv,) Reference before the tick [rad].
    v: Array  # (nv,) Velocity of the reference before the tick [rad/s].
    targets: dict[str, Any]  # For each arm, a homogeneous matrix (4, 4), or the text of a target that is no pose.
    dt: str  # Duration of the tick, as text.
    error: str  # Text of the exception; empty if there was none.


@dataclass(frozen=True, slots=True)
class SoakReport:
    """The results of a soak."""

    cell: str
    solver: str
    seed: int
    ticks: int
    simulated_s: float
    counts: dict[str, int]  # See :data:`COUNTED`.
    margins: list[Margin]
    memory_growth_mb: float | None  # See :func:`steady_growth`; None if it was not measured.
    broken: list[Violation]  # The first violation of each promise, in the order of their ticks.
    seeds: int = 1  # The number of soaks, with the seeds from ``seed`` on. Ticks, times and counts are sums over them.

    @property
    def passed(self) -> bool:
        """Whether every promise was kept and memory did not grow."""
        lean = self.memory_growth_mb is None or self.memory_growth_mb <= MEMORY_ALLOWED
        return lean and not any(margin.violations for margin in self.margins)

    def as_json(self) -> dict[str, Any]:
        """Return the data for the JSON writer."""
        data = {field.name: getattr(self, field.name) for field in fields(self)}
        return data | data.pop("counts") | {"passed": self.passed}


def run_soak(
    config: Config,
    ticks: int,
    seed: int,
    progress: Callable[[str], None] = lambda what: None,
    solver: Solver | None = None,
) -> SoakReport:
    """Run a soak of the controller of a cell.

    At ticks without an injected fault, ``solver`` is used. If it is None, the cell's solver is used.
    """
    robot = Robot.from_config(config)
    settings = config.control.timed(realtime=True)
    # The solver gets no time limit, so that a soak with the same seed finds the same faults again on any computer.
    simulated = config.control.timed(realtime=False)
    inner = solver_of(simulated, robot.model.nv) if solver is None else Guard(solver, robot.model.nv)
    name = config.control.solver if solver is None else type(solver).__name__
    worst = WorstSolver(robot, np.random.default_rng([seed, 6]))
    faulty = FaultySolver(inner, np.random.default_rng([seed, 1]), worst)
    # Targets are not interpolated from tick to tick (bridge_held): targets that jump are harder for the controller.
    controller = CartesianController(robot, settings, solver=untimed(faulty, robot.model.nv), bridge_held=False)
    return Soak(config.name, controller, faulty, seed, name).run(ticks, progress)


class Soak:
    """Drives a controller through random segments, and checks every tick."""

    def __init__(
        self, cell: str, controller: CartesianController, solver: FaultySolver, seed: int, solver_name: str = DAQP
    ) -> None:
        self._cell, self._controller, self._solver, self._seed = cell, controller, solver, seed
        self._solver_name = solver_name
        self._hostile = HostileChanges(controller, seed)
        self._contract = Contract(controller, random=np.random.default_rng([seed, 2]))
        self._broken: dict[str, Violation] = {}
        self._counts = Counter(dict.fromkeys(COUNTED, 0))
        self._simulated = 0.0

    def run(self, ticks: int, progress: Callable[[str], None] = lambda what: None) -> SoakReport:
        """Run ``ticks`` ticks."""
        measured, memory = [round(share * ticks) for share in _MEASURED_AFTER], list[float | None]()
        for tick, (segment, since) in enumerate(self._ticks(ticks)):
            if tick in measured:
                memory.append(_memory_mb())
            if tick % max(ticks // 20, 1) == 0:
                progress(f"tick {tick} of {ticks}")
            self._tick(tick, segment, since)
        memory.append(_memory_mb())
        return SoakReport(
            cell=self._cell,
            solver=self._solver_name,
            seed=self._seed,
            ticks=ticks,
            simulated_s=self._simulated,
            margins=list(self._contract.margins.values()),
            memory_growth_mb=steady_growth(memory),
            counts=dict(self._counts),
            broken=list(self._broken.values()),
        )

    def _ticks(self, ticks: int) -> Iterator[tuple[Segment, int]]:
        """Yield, for each tick, its segment and its number in the segment.

        A segment with a start resets the controller.
        """
        left = ticks
        robot, settings = self._controller.robot, self._controller.settings
        kept = kept_distances(robot, settings).values
        for segment in segments(robot, kept, np.random.default_rng([self._seed, 0])):
            self._counts["segments"] += 1
            if segment.start is not None:
                self._reset(segment.start.q, segment.start.v)
            for since in range(min(segment.ticks, left)):
                yield segment, since
            left -= segment.ticks
            if left <= 0:
                return

    def _reset(self, q: Array, v: Array) -> None:
        self._counts["resets"] += 1
        self._controller.reset(q, v)
        self._contract.start(q, v)
        self._q, self._v = q, v

    def _tick(self, tick: int, segment: Segment, since: int) -> None:
        fault, dt = segment.fault_at(since), segment.dt()
        request = segment.stream(since, self._q)
        self._solver.fault, self._solver.q, self._solver.kept = fault, self._q, self._controller.kept_distances
        self._change_cell()
        try:
            reference = self._controller.step(request.targets, dt)
        except Exception as error:  # Any exception breaks the contract, which promises that ``step`` raises nothing.
            self._contract.raised()
            self._keep(tick, segment, since, request, dt, ["exceptions"], f"{type(error).__name__}: {error}")
            self._reset(self._controller.robot.home, np.zeros_like(self._q))
            return
        if broken := self._contract.observe(reference, dt, request.unusable, fault in STOPPING_FAULTS):
            self._keep(tick, segment, since, request, dt, broken, "")
        if "not_finite" in broken:
            self._reset(self._controller.robot.home, np.zeros_like(self._q))
            return
        self._q, self._v = reference.q, reference.v
        self._simulated += time_of(dt)
        self._counts["solver_faults"] += fault is not None
        self._counts["attacks"] += fault in ATTACKS
        self._counts["fallbacks"] += reference.report.fallback
        self._counts["fallbacks_healthy"] += reference.report.fallback and fault is None
        self._counts["unsolved"] += reference.report.unsolved > 0 and fault is None

    def _change_cell(self) -> None:
        """Change openings of grippers, grasps and settings at random."""
        if (opening := self._hostile.opening()) is not None:
            arm, interval = opening
            self._counts["openings"] += 1
            self._counts["openings_refused"] += self._controller.set_opening(arm, *interval) is not None
            self._contract.set_openings(self._controller.openings)
        if (grasp := self._hostile.grasp()) is not None:
            self._counts["grasps"] += 1
            self._controller.set_holding(*grasp)
        if (values := self._hostile.settings()) is not None:
            self._counts["changes"] += self._controller.change(values) is None

    def _keep(
        self, tick: int, segment: Segment, since: int, request: Request, dt: Any, broken: Iterable[str], error: str
    ) -> None:
        poses = {
            arm: target.homogeneous if isinstance(target, pin.SE3) else repr(target)
            for arm, target in request.targets.items()
        }
        for key in broken:
            name = self._contract.margins[key].name
            found = Violation(name, self._seed, tick, str(segment), since, self._q, self._v, poses, repr(dt), error)
            self._broken.setdefault(key, found)


def steady_growth(memory: Sequence[float | None]) -> float | None:
    """Return the growth of ``memory`` that a leak may have caused from the first measurement to the last [MB].

    A leak adds the same amount in each of the equal spans between measurements. The heap also grows until it can hold
    the largest tick, but only in some spans. Therefore the least growth of a span counts, times the number of spans.

    Args:
        memory: Two or more measurements [MB]; None if the system gave no value.

    Returns:
        The growth [MB]; None if a measurement is missing.
    """
    known = [value for value in memory if value is not None]
    if len(known) < len(memory):
        return None
    return (len(known) - 1) * min(after - before for before, after in pairwise(known))


def _memory_mb() -> float | None:
    """Return the memory of this process after garbage collection, without pages of files [MB]; None if unknown.

    Pages of files are left out, because pages of a library become resident when a function is first called.
    """
    gc.collect()
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(r"^RssAnon:\s+(\d+) kB", status, re.MULTILINE)
    return None if found is None else int(found[1]) / 1024
