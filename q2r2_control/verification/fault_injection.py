"""Makes the input of a soak: segments of hostile targets, uneven ticks, failing or hostile solvers, and bad starts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.control import ContactPair
from q2r2_control.control.qp import QpProblem, QpSolution, Solver
from q2r2_control.control.solvers.guard import Guard
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.pairs import distance_gradient
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.adversary import Adversary, Stream

# The attacks, which are ways in which a solver works against the arms:
# - "towards_nearest": it chooses one of the pairs with the least margins. Its answer is the vertex of the QP's box at
#   which the two bodies of this pair approach each other fastest.
# - "corner": its answer is a random vertex of the box, which it keeps for some ticks.
# - "again": it repeats its last answer, even if the box has changed since.
# - "no_rows": it solves the QP without the separation rows. This solution leads straight to the targets.
ATTACKS = ("towards_nearest", "corner", "again", "no_rows")
_PATIENCE = 200  # Largest number of ticks for which an attack goes on with the same pair or the same corner.
_CANDIDATES = 4  # An attack chooses one of this number of pairs with the least margins.


class WorstSolver:
    """Makes the answers of a solver that attacks. Coal measures the distances, and Pinocchio their gradients."""

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self._random = random
        self._distances = CoalDistances(robot.model, robot.collision_model)
        self._signs = np.ones(robot.model.nv)
        self._last = np.zeros(robot.model.nv)
        self._left = 0
        self._rank = 0

    def answer(self, attack: str, problem: QpProblem, q: Array, kept: Array) -> Array:
        """Return velocities (nv,) [rad/s] at the posture ``q`` (nv,), where pairs keep ``kept`` (p,) [m]."""
        if attack == "again":
            return self._last
        self._left -= 1
        renewed = self._left <= 0
        if renewed:
            self._left = int(self._random.integers(1, _PATIENCE))
            self._rank = int(self._random.geometric(0.6)) - 1
        if attack == "towards_nearest":
            self._signs = -np.sign(self._gradient(q, kept))
        elif renewed:
            self._signs = self._random.choice([-1.0, 1.0], size=len(self._signs))
        self._last = np.where(self._signs > 0.0, problem.upper, problem.lower)
        return self._last

    def _gradient(self, q: Array, kept: Array) -> Array:
        """Return the gradient (nv,) of the distance of one pair, which has one of the least margins [m/rad]."""
        model, geometries = self._distances.model, self._distances.geometry
        data, geometry_data = self._distances.data, self._distances.geometry_data
        pin.computeJointJacobians(model, data, q)
        pin.updateGeometryPlacements(model, data, geometries, geometry_data)
        pin.computeDistances(geometries, geometry_data)
        margins = self._distances.measured() - kept
        nearest = int(np.argsort(margins)[min(self._rank, len(margins) - 1, _CANDIDATES - 1)])
        return distance_gradient(model, data, geometries, geometry_data, nearest)


# Solver failures that require the certified stop. A solution of absurd numbers is clipped to the limits instead.
STOPPING_FAULTS = ("none", "nan", "one_nan", "infinite", "late")
FAULTS = (*STOPPING_FAULTS, "absurd", "noise")
_ATTACK_SHARES = (0.6, 0.15, 0.1, 0.15)  # Probabilities of ATTACKS in a segment whose solver attacks.
_FAULTY, _ATTACKED = 0.2, 0.3  # Probabilities that the solver of a segment fails, or works against the arms.
# Kinds of tick durations in a segment.
_TIMINGS = ("1 ms", "1 ms, jittering", "a few ms", "any", "tiny", "long", "partly invalid")
_TIMING_SHARES = (0.42, 0.20, 0.15, 0.08, 0.05, 0.04, 0.06)  # Probability of each of the _TIMINGS in a segment.
_INVALID_DT: tuple[Any, ...] = (0.0, -0.001, math.nan, math.inf, -math.inf, None, "soon", 0.2, 5.0)
_STARTS = ("home", "apart", "anywhere", "outside", "at limits", "moving", "too fast", "in penetration")
LATE = 1.0  # Solve time of a late solution [s].
_DEEPEST = -0.03  # Least distance of a pair at a start in penetration [m].


def untimed(solver: Solver, nv: int) -> Guard:
    """Return ``solver`` with a guard that measures no time.

    The guard uses only the solve time that the solver reports, so that no result depends on the computer's load.
    """
    return Guard(solver, nv, clock=lambda: 0.0)


class FaultySolver:
    """A real solver that fails as :attr:`fault` says: one of ``FAULTS`` or ``ATTACKS``, or None if it does not fail.

    Its solve times are invented, so that no result depends on the load of the machine. If :attr:`fault` is an attack
    other than "no_rows", ``worst`` answers instead. It uses the posture :attr:`q` (nv,) [rad] and the kept distances
    :attr:`kept` (p,) [m], which the caller sets before each step.
    """

    def __init__(
        self, inner: Solver, random: np.random.Generator | None = None, worst: WorstSolver | None = None
    ) -> None:
        self._inner, self._random = inner, np.random.default_rng(0) if random is None else random
        self.worst = worst
        self.fault: str | None = None
        self.q, self.kept = np.zeros(0), np.zeros(0)

    def solve(self, problem: QpProblem) -> QpSolution:
        if self.fault == "no_rows":
            problem = replace(problem, rows=problem.rows[:0], rows_lower=problem.rows_lower[:0], minimum=None)
        elif self.fault in ATTACKS and self.worst is not None:
            return QpSolution(self.worst.answer(self.fault, problem, self.q, self.kept), 0.0)
        v, nv = self._inner.solve(problem).v, len(problem.g)
        if self.fault is None or self.fault in ATTACKS:
            return QpSolution(v, 0.0)
        if self.fault == "one_nan":
            broken = np.zeros(nv) if v is None else np.array(v)
            broken[self._random.integers(nv)] = np.nan
            return QpSolution(broken, 0.0)
        return {
            "none": QpSolution(None, 0.0),
            "nan": QpSolution(np.full(nv, np.nan), 0.0),
            "infinite": QpSolution(np.full(nv, -np.inf), 0.0),
            "late": QpSolution(v, LATE),
            "absurd": QpSolution(np.full(nv, 1e12), 0.0),
            "noise": QpSolution(self._random.normal(size=nv) * 10.0, 0.0),
        }[self.fault]


class PushingSolver:
    """A solver that drives all joints as fast as the box allows, for ``ticks`` ticks in each of many directions."""

    def __init__(self, ticks: int) -> None:
        self._random, self._ticks, self._left = np.random.default_rng(72), ticks, 0
        self._signs = np.ones(1)

    def solve(self, problem: QpProblem) -> QpSolution:
        if self._left == 0:
            self._left, self._signs = self._ticks, self._random.choice([-1.0, 1.0], len(problem.g))
        self._left -= 1
        return QpSolution(np.where(self._signs > 0.0, problem.upper, problem.lower), 0.0)


@dataclass(frozen=True, slots=True)
class Start:
    """The state to which a controller is reset."""

    name: str
    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]


@dataclass(frozen=True, slots=True)
class Segment:
    """A sequence of ticks of one kind."""

    targets: str  # Name of the stream of targets.
    timing: str  # Kind of the ticks' durations.
    ticks: int  # Number of ticks.
    start: Start | None  # The first state; None if the segment continues from the previous segment.
    fault: str | None  # The fault of the solver; None if the solver works.
    fault_period: int  # The solver fails in every second period of this many ticks. An attack lasts the whole segment.
    stream: Stream
    dt: Callable[[], Any]  # Returns the duration of the next tick [s], which may be invalid.

    def fault_at(self, tick: int) -> str | None:
        """Return the fault of the solver in a tick of this segment; None if the solver works in this tick."""
        lasts = self.fault in ATTACKS or (tick // self.fault_period) % 2 == 0
        return self.fault if lasts else None

    def __str__(self) -> str:
        start = "" if self.start is None else f", from {self.start.name}"
        fault = "" if self.fault is None else f", solver: {self.fault}"
        return f"{self.targets}, dt {self.timing}{start}{fault}"


def segments(robot: Robot, kept: Array, random: np.random.Generator) -> Iterator[Segment]:
    """Yield segments without end. The first one starts at home. ``kept`` (p,) are the distances that pairs keep [m]."""
    adversary, starts = Adversary(robot, random), Starts(robot, kept, random)
    start: Start | None = starts.draw("home")
    while True:
        timing = str(random.choice(_TIMINGS, p=_TIMING_SHARES))
        name = str(random.choice(Adversary.names))
        longest = 60 if timing == "long" else 300 if timing == "any" else 2500
        yield Segment(
            targets=name,
            timing=timing,
            ticks=int(np.exp(random.uniform(np.log(20), np.log(longest)))),
            start=start,
            fault=_fault(random),
            fault_period=int(random.integers(1, 150)),
            stream=adversary.stream(name),
            dt=_ticks(timing, random),
        )
        start = starts.draw(str(random.choice(_STARTS))) if random.random() < 0.3 else None


def _fault(random: np.random.Generator) -> str | None:
    share = random.random()
    if share < _ATTACKED:
        return str(random.choice(ATTACKS, p=_ATTACK_SHARES))
    return str(random.choice(FAULTS)) if share < _ATTACKED + _FAULTY else None


def _ticks(timing: str, random: np.random.Generator) -> Callable[[], Any]:
    middle = float(random.choice([0.002, 0.004, 0.005, 0.01])) if timing == "a few ms" else 0.001
    return {
        "1 ms": lambda: middle,
        "1 ms, jittering": lambda: middle * random.uniform(0.2, 2.5),
        "a few ms": lambda: middle * random.uniform(0.8, 1.2),
        "any": lambda: 10.0 ** random.uniform(-6.0, -1.0),
        "tiny": lambda: 10.0 ** random.uniform(-6.0, -4.0),
        "long": lambda: random.uniform(0.02, 0.1),
        "partly invalid": lambda: _INVALID_DT[random.integers(len(_INVALID_DT))] if random.random() < 0.1 else middle,
    }[timing]


class Starts:
    """Chooses random states to which a controller is reset."""

    def __init__(self, robot: Robot, kept: Array, random: np.random.Generator) -> None:
        self._robot, self._kept, self._random = robot, kept, random

    def draw(self, name: str) -> Start:
        """Return a random start of the kind ``name``.

        The arms are at rest, except for the kinds "moving" and "too fast".
        """
        robot, random, nv = self._robot, self._random, self._robot.model.nv
        kinds = {"home": robot.home.copy, "anywhere": self._posture, "in penetration": self._in_penetration}
        q, v = kinds.get(name, self._apart)(), np.zeros(nv)
        if name == "outside":
            joints = random.random(nv) < 0.2
            beyond = random.uniform(-0.01, 0.1, size=nv)
            q = np.where(joints, np.where(q > 0, robot.position_upper + beyond, robot.position_lower - beyond), q)
        elif name == "at limits":
            margin = float(random.choice([0.0, 0.01]))
            nearest = np.where(q > 0, robot.position_upper - margin, robot.position_lower + margin)
            q = np.where(random.random(nv) < 0.3, nearest, q)
        elif name in ("moving", "too fast"):
            v = random.uniform(-1.0, 1.0, size=nv) * robot.velocity_limit * (0.5 if name == "moving" else 1.5)
        return Start(name, q, v)

    def _posture(self) -> Array:
        return self._random.uniform(self._robot.position_lower, self._robot.position_upper)

    def _apart(self) -> Array:
        """Return a random posture with all pairs apart, or home if none is found soon."""
        for _ in range(50):
            q = self._posture()
            if (self._robot.distance_values(q) >= self._kept).all():
                return q
        return self._robot.home.copy()

    def _in_penetration(self) -> Array:
        """Return a posture in which the distance of at least one pair is slightly too small.

        It lies on the straight line from home to a random posture in penetration.
        """
        far = self._posture()
        for _ in range(50):
            if (self._robot.distance_values(far) < 0.0).any():
                break
            far = self._posture()
        wanted = self._random.uniform(_DEEPEST - self._kept.max(initial=0.0), 0.0)
        low, high = 0.0, 1.0
        for _ in range(12):
            share = 0.5 * (low + high)
            distances = self._robot.distance_values(self._robot.home + share * (far - self._robot.home))
            closer = (distances < np.maximum(self._kept + wanted, _DEEPEST)).any()
            low, high = (low, share) if closer else (share, high)
        q: Array = self._robot.home + high * (far - self._robot.home)
        return q


# Pairs that may touch. With TABLE_ONLY, fingers may touch the table. With FINGERS, they may also touch the other arm's
# fingers.
TABLE_ONLY = (ContactPair(pair=("*_finger_*", "table")),)
FINGERS = (*TABLE_ONLY, ContactPair(pair=("left_*_finger_*", "right_*_finger_*"), depth=0.005))


def with_contact(config: Config, pairs: tuple[ContactPair, ...]) -> Config:
    """Return the cell with ``pairs`` that may touch. A cell that allows contact already is not changed."""
    if config.control.contact_allowed:
        return config
    return config.model_copy(update={"control": config.control.model_copy(update={"contact_allowed": pairs})})
