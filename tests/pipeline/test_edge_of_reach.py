"""Hands move beyond the edge of reach, over a network that delays samples in bursts. No tool stands still meanwhile."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import count, pairwise

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.inputs.played import PlayedInput, SampleTiming
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, Array, HandInputs
from tests.pipeline.loops import pipeline
from tests.support.processes import Watch, cell

SECONDS, RATE = 37.0, 72.0  # Duration [s], and rate of the hands [Hz].
LET_THROUGH = 1.0  # Time between two delays of the network [s].
# Delays of the network [s]. In six of seven delays, ten samples wait. The seventh delay is so long that the input's
# gate times out.
HELD_UP = 0.13, 0.165
FROM, BEYOND = -0.15, 0.15  # Range of the targets relative to the edge of reach [m].
# Longest time in which a target may move while its tool does not, for example where the target reverses [s].
STALL = 0.16
SLOW, STEP = 0.05, 9.0  # A target moves if its speed is between these. A faster target has jumped [m/s].
_WAITS = 0.4  # An operator whose arm does not follow presses after this time [s].


class Bursts(SampleTiming):
    """Samples are taken at a constant rate. All samples that wait during a network delay arrive together at its end."""

    def __init__(self) -> None:
        self._t = 0.0

    def times(self) -> Iterator[float]:
        for index in count():
            self._t = index / RATE
            yield self._t

    def lateness(self) -> float:
        number, within = divmod(self._t, LET_THROUGH)
        held_up = HELD_UP[0 if (number + 1) % 7 else 1]
        return max(held_up - within, 0.0) if number else 0.0


class Sweeping(PlayedInput):
    """Both hands move the tools to and fro across the edge of reach, and press if an arm does not follow."""

    def __init__(self) -> None:
        self._idle_since: float | None = None
        self.homes: dict[str, pin.SE3] = {}
        self.shoulders: dict[str, Array] = {}
        self._pressing = False
        robot = Robot.from_config(cell())
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, robot.home)
        for arm, its in robot.arms.items():
            self.homes[arm] = robot.tool_pose(robot.home, arm)
            names = [robot.joint_names[index] for index in its.joints]
            places = [data.oMi[robot.model.getJointId(name)].translation for name in names]
            self.shoulders[arm] = places[1]
            self.reach = float(np.linalg.norm(places[3] - places[1]) + np.linalg.norm(places[5] - places[3]))
            self.reach += float(np.linalg.norm(self.homes[arm].translation - places[5]))
        super().__init__(self._posed, self._pressed, {hand: Bursts() for hand in SIDES})

    def look(self, tick: Tick) -> None:
        if all(tick.engaged.values()):
            self._idle_since = None
            self._pressing = False
        elif self._idle_since is None:
            self._idle_since = tick.t
        else:
            self._pressing = (tick.t - self._idle_since) % (2.0 * _WAITS) > _WAITS

    def _posed(self, hand: str, t: float) -> pin.SE3:
        home, shoulder = self.homes[hand], self.shoulders[hand]
        side = 1.0 if hand == "left" else -1.0
        out = home.translation - shoulder
        away, up = math.atan2(out[1], out[0]), math.atan2(out[2], math.hypot(out[0], out[1]))
        grown = min(t / 4.0, 1.0)
        away += grown * side * (0.5 + 0.6 * math.sin(2.0 * math.pi * 0.17 * t))
        up += grown * 0.4 * math.sin(2.0 * math.pi * 0.11 * t)
        radius = self.reach + (FROM + BEYOND) / 2.0 - (BEYOND - FROM) / 2.0 * math.cos(2.0 * math.pi * 0.23 * t)
        radius += (1.0 - grown) * (float(np.linalg.norm(out)) - radius)
        way = radius * np.array([math.cos(away) * math.cos(up), math.sin(away) * math.cos(up), math.sin(up)])
        return pin.SE3(np.eye(3), shoulder + way)

    def _pressed(self, hand: str, t: float) -> HandInputs:
        return HandInputs(button_lower=self._pressing)


def stalls(ticks: list[Tick], arm: str) -> list[float]:
    """Return the durations for which the target moves while the tool does not [s]."""
    found = [0.0]
    for before, tick in pairwise(ticks):
        target, last = tick.targets[arm].pose, before.targets[arm].pose
        dt, stuck = tick.t - before.t, False
        if target is not None and last is not None:
            moves = float(np.linalg.norm(target.translation - last.translation)) / dt
            follows = float(np.linalg.norm(tick.tools[arm].translation - before.tools[arm].translation)) / dt
            stuck = SLOW < moves < STEP and follows < 0.1 * moves
        if stuck:
            found[-1] += dt
        elif found[-1] > 0.0:
            found.append(0.0)
    return found


@pytest.mark.slow
def test_no_arm_at_the_edge_of_reach_stands_still_while_its_target_moves_even_if_samples_come_in_bursts() -> None:
    hands = Sweeping()
    loop = pipeline(hands)
    loop.listeners.append(hands.look)
    watch = Watch(loop)
    summary = loop.run(SECONDS, realtime=False)
    for arm in SIDES:
        assert max(stalls(watch.ticks, arm), default=0.0) < STALL
        assert sum(tick.engaged[arm] for tick in watch.ticks) > 0.9 * len(watch.ticks)
        assert summary.arms[arm].slip_mm_max > 500.0, "the hands went beyond the edge again and again"
        assert len(watch.engagements(arm)) > 5, "and were held up for longer than the gate waits"
    assert summary.fallback_ticks < 0.005 * len(watch.ticks)
