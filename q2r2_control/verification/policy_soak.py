"""A long run of a hostile policy through the whole pipeline. Every promise of the contract is checked at each tick."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.inputs.policy import ActionSpace, PolicyInput, action_names
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.teleop.policy_motion import SILENT
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.promises import Margin
from q2r2_control.verification.soak import SoakReport, Violation

COUNTED = {
    "segments": "segments",
    "chunks": "chunks of actions",
    "policy_ticks": "arms moved by the policy, in ticks",
    "begins": "times that an arm began to follow",
    "stops": "stops by a fault of the actions",
    "stalls": "stalls of the policy",
    "fallbacks": "certified stops executed",
}
STREAMS = ("walk", "limits", "other_arm", "oscillate", "random", "broken", "late", "stall")
_MOST, _LONGEST = 8, 0.4  # Largest number of actions in a chunk, and longest duration of a chunk [s].
_STOPS = 1.0  # Time in which all arms have to come to rest after the last action that is followed [s].
_PERIODS = (0.02, 0.1)  # Range of the time between two actions [s].
_TOOLS = np.array(
    [[-0.6, -1.1, -0.1], [1.1, 1.1, 1.4]]
)  # Numbers from which the coordinates of far targets are drawn [m].


class _Segment(NamedTuple):
    """A stream of one kind that lasts some ticks."""

    stream: str
    space: ActionSpace
    ticks: int
    every: int  # Number of ticks from one chunk to the next.
    step: float  # Largest step of an action [m or rad].
    goal: Array  # The goal of most streams, as an action.


class HostilePolicy:
    """Makes random actions.

    Most actions begin at the arms' present poses, because other actions would be refused and would move nothing.
    """

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self._robot, self._random = robot, random
        self._colliding = self._postures_in_collision()

    def _posture(self) -> Array:
        return self._random.uniform(self._robot.position_lower, self._robot.position_upper)

    def _postures_in_collision(self) -> list[Array]:
        """Return postures in which one arm is inside the other."""
        arms = tuple(self._robot.arms)
        names = [(pair.name_a, pair.name_b) for pair in self._robot.distances(self._robot.home)]
        between = [index for index, pair in enumerate(names) if {name.split("_")[0] for name in pair} == set(arms)]
        found: list[Array] = []
        while len(found) < 10:
            q = self._posture()
            if self._robot.distance_values(q)[between].min() < -0.02:
                found.append(q)
        return found

    def draw(self, segment: _Segment, tick: Tick) -> tuple[Any, Any]:
        """Return random actions (n, size) and their times (n,) [s]. Actions or times of some streams are invalid."""
        random, names = self._random, action_names(self._robot, segment.space)
        count = int(random.integers(1, _MOST + 1))
        period = random.uniform(*_PERIODS)
        times: Array = np.asarray(tick.now + min(period, _LONGEST / count) * np.arange(count))
        if segment.stream == "broken":
            return self._broken(np.zeros((count, len(names))), times)
        if segment.stream == "random":
            return random.normal(scale=10.0 ** random.uniform(-3.0, 3.0), size=(count, len(names))), times
        if segment.stream == "late":
            times = times + random.uniform(-1.0, 0.0)
        start, goal = self._start(segment.space, tick), segment.goal
        shares = np.arange(1, count + 1) * min(segment.step / max(float(np.abs(goal - start).max()), 1e-9), 1.0)
        if segment.stream == "oscillate":
            shares *= np.where(np.arange(count) % 2, 1.0, -1.0)
        actions = start + np.minimum(shares, 1.0)[:, None] * (goal - start)
        if random.random() < 0.5:
            actions = np.hstack((actions, random.uniform(-0.5, 1.5, (count, len(self._robot.arms)))))
        return actions, times

    def _start(self, space: ActionSpace, tick: Tick) -> Array:
        if space is ActionSpace.JOINTS:
            return tick.reference.q
        if space is ActionSpace.TOOL:
            return np.concatenate([pin.SE3ToXYZQUAT(tick.tools[arm]) for arm in self._robot.arms])
        return np.zeros(6 * len(self._robot.arms))

    def goal(self, stream: str, space: ActionSpace, step: float) -> Array:
        """Return a random goal of a stream (size,).

        The goal is an action. The actions of most streams approach it step by step. In the space of tool motions, the
        goal is the motion in each action.
        """
        random, robot = self._random, self._robot
        q = self._posture()
        if stream == "limits":
            q = np.where(random.random(len(q)) < 0.5, robot.position_lower, robot.position_upper) * 1.2
        if stream == "other_arm":
            q = self._colliding[int(random.integers(len(self._colliding)))]
        if space is ActionSpace.JOINTS:
            return np.asarray(q)
        if space is ActionSpace.TOOL_DELTA:
            return np.asarray(random.choice([-1.0, 1.0], 6 * len(robot.arms)), dtype=float) * step
        poses = [pin.SE3ToXYZQUAT(robot.tool_pose(q, arm)) for arm in robot.arms]
        if stream == "limits":
            for pose in poses:
                pose[:3] = random.choice(_TOOLS.ravel(), 3)
        return np.concatenate(poses)

    def _broken(self, actions: Array, times: Array) -> tuple[Any, Any]:
        """Return actions that no policy should send."""
        random = self._random
        place = tuple(int(random.integers(size)) for size in actions.shape)
        actions[place] = random.choice([np.nan, np.inf, -np.inf, 1e300])
        kinds: tuple[tuple[Any, Any], ...] = (
            (actions, times),
            (actions[:, 1:], times),
            (np.zeros((0, actions.shape[1])), times),
            (np.zeros((2, 2, 2)), times),
            ("left", times),
            ([[None]], times),
            (np.zeros_like(actions), times[::-1]),
            (np.zeros_like(actions), times + 1e9),
            (np.zeros_like(actions), np.nan * times),
            (np.zeros_like(actions), "now"),
        )
        return kinds[int(random.integers(len(kinds)))]


class PolicySoak:
    """Runs a cell with a hostile policy and no operator, on a plant that follows exactly."""

    def __init__(self, config: Config, seed: int, streams: Sequence[str] = STREAMS) -> None:
        self._streams, self._round = streams, list[str]()  # Each stream comes once per round.
        config = config.model_copy(update={"control": config.control.timed(realtime=False)})
        self._cell, self._seed, self._period = config.name, seed, 1.0 / config.nominal_rate_hz
        self._input = PolicyInput()
        self._pipeline = Pipeline.from_config(config, input=self._input, plant="kinematic")
        self._contract = Contract(self._pipeline.controller, random=np.random.default_rng([seed, 1]))
        self._openings = self._pipeline.controller.openings
        self._random = np.random.default_rng([seed, 2])
        self._policy = HostilePolicy(self._pipeline.robot, np.random.default_rng([seed, 3]))
        self._rest = Margin("speed after a stall of the policy", "rad/s", "<=", 1e-3)
        self._counts = Counter(dict.fromkeys(COUNTED, 0))
        self._broken: dict[str, Violation] = {}
        self._ticks, self._since, self._segment = 0, 0, self._drawn()
        self._last: Tick | None = None
        self._pipeline.listeners.append(self._tick)

    def run(self, ticks: int, progress: Callable[[str], None] = lambda what: None) -> SoakReport:
        """Run ``ticks`` ticks."""

        def show(tick: Tick) -> None:
            if self._ticks % max(ticks // 20, 1) == 0:
                progress(f"tick {self._ticks} of {ticks}")

        self._pipeline.listeners.append(show)
        # This logger is switched off, because it would print every provoked fault.
        log = logging.getLogger("q2r2_control.pipeline.operator_side")
        log.disabled = True
        try:
            self._pipeline.run(ticks * self._period, realtime=False)
        except Exception as error:  # A policy must not end the run.
            self._contract.raised()
            self._keep("exceptions", self._contract.margins["exceptions"], f"{type(error).__name__}: {error}")
        finally:
            log.disabled = False
        return SoakReport(
            solver=self._pipeline.config.control.solver,
            cell=self._cell,
            seed=self._seed,
            ticks=self._ticks,
            simulated_s=self._ticks * self._period,
            counts=dict(self._counts),
            margins=[*self._contract.margins.values(), self._rest],
            # The growth is not measured, because it would include the summary's bounded list of events.
            memory_growth_mb=None,
            broken=list(self._broken.values()),
        )

    def _drawn(self) -> _Segment:
        random = self._random
        if not self._round:
            self._round = [str(stream) for stream in random.permutation(self._streams)]
        stream = self._round.pop()
        space = tuple(ActionSpace)[int(random.integers(len(ActionSpace)))]
        every = 1 if random.random() < 0.5 else int(random.integers(2, 100))
        ticks = (
            int(random.integers(100, 800)) if stream != "stall" else round((SILENT + _LONGEST + _STOPS) / self._period)
        )
        self._counts["segments"] += 1
        step = 10.0 ** random.uniform(-3.0, -1.2)
        return _Segment(stream, space, ticks, every, step, self._policy.goal(stream, space, step))

    def _tick(self, tick: Tick) -> None:
        self._ticks += 1
        if (openings := self._pipeline.controller.openings) != self._openings:
            self._openings = openings
            self._contract.set_openings(openings, before_step=False)
        for key in self._contract.observe(tick.reference, tick.step):
            self._keep(key, self._contract.margins[key], "")
        self._last = tick
        self._counts["fallbacks"] += tick.reference.report.fallback
        self._counts["policy_ticks"] += sum(state == ArmState.POLICY for state in tick.states.values())
        for event in tick.events:
            self._counts["begins"] += event.destination == ArmState.POLICY
            self._counts["stops"] += event.source == ArmState.POLICY
        if tick.following:
            self._send(tick)

    def _keep(self, key: str, margin: Margin, error: str) -> None:
        """Keep the first violation of a promise, with the tick before it."""
        q, v = (
            (self._pipeline.robot.home,) * 2 if self._last is None else (self._last.reference.q, self._last.reference.v)
        )
        targets = {} if self._last is None else self._last.targets
        poses = {arm: target.pose.homogeneous for arm, target in targets.items() if target.pose is not None}
        dt = f"{self._period:g}"
        segment = str(self._segment)
        found = Violation(margin.name, self._seed, self._ticks, segment, self._since, q, v, poses, dt, error)
        self._broken.setdefault(key, found)

    def _send(self, tick: Tick) -> None:
        segment = self._segment
        if self._since >= segment.ticks:
            if segment.stream == "stall":
                self._counts["stalls"] += 1
                follows = ArmState.POLICY in tick.states.values()
                speed = float("inf") if follows else float(np.abs(tick.reference.v).max())
                if not self._rest.note(speed, self._ticks):
                    self._keep("rest", self._rest, "")
            segment, self._since = self._drawn(), 0
            self._segment = segment
        if segment.stream != "stall" and self._since % segment.every == 0:
            self._input.space = segment.space
            self._input.send(*self._policy.draw(segment, tick))
            self._counts["chunks"] += 1
        self._since += 1
