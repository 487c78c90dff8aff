"""An operator for the teleop tests: two hands, a loop, and arms that stay where they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Event, Reason
from q2r2_control.teleop.arm_states import is_refusal
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES, ArmTarget, Array, HandInputs, HandSample
from tests.support.reasons import kinds

TICK = 0.001  # Period of the loop [s].
PERIOD = 0.013  # Period of the hands' samples [s].


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> pin.SE3:
    return pin.SE3(pin.exp3(np.array(turn)), np.array([x, y, z]))


def sample(
    hand: str, hand_pose: pin.SE3, stamp: float, *, lower: bool = False, upper: bool = False, sign: float = 1.0
) -> HandSample:
    quaternion = sign * pin.Quaternion(hand_pose.rotation).coeffs()
    inputs = HandInputs(button_upper=upper, button_lower=lower)
    return HandSample(hand, hand_pose.translation.copy(), quaternion, stamp, inputs, stamp)


@dataclass
class Operator:
    """An operator who feeds a :class:`Teleop` at 1 kHz with samples of both hands at about 77 Hz."""

    settings: TeleopSettings = field(default_factory=TeleopSettings)
    arms: tuple[str, ...] = SIDES
    now: float = 10.0
    hands: dict[str, pin.SE3] = field(
        default_factory=lambda: {"left": pose(0.3, 0.2, 1.0), "right": pose(0.3, -0.2, 1.0)}
    )
    tools: dict[str, pin.SE3] = field(
        default_factory=lambda: {
            "left": pose(0.5, 0.4, 0.4, (np.pi, 0.0, 0.0)),
            "right": pose(0.5, -0.4, 0.4, (0.0, 3.0, 0.3)),
        }
    )
    commanded: dict[str, pin.SE3] | None = None
    in_step: bool = True
    obstacles: dict[str, Reason] = field(default_factory=dict)
    lower: set[str] = field(default_factory=set)  # Hands that hold the lower button.
    upper: set[str] = field(default_factory=set)  # Hands that hold the upper button.
    # How far each control is pushed, from 0 to 1. The keys are the names that controls have in the bindings.
    held: dict[str, float] = field(default_factory=dict)
    only: str | None = None  # The hand that pushes the controls in ``held``; None if both hands do.
    silent: set[str] = field(default_factory=set)  # Hands that send nothing.
    # Changes each sample before it is sent.
    alter: Callable[[HandSample], HandSample] = lambda received: received
    events: list[Event] = field(default_factory=list)
    targets: dict[str, ArmTarget] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.teleop = Teleop(self.settings, self.arms)
        self._next_sample = self.now

    def samples(self) -> list[HandSample]:
        """Return the samples that the hands send now."""
        found = [
            sample(hand, self.hands[hand], self.now, lower=hand in self.lower, upper=hand in self.upper)
            for hand in SIDES
            if hand not in self.silent
        ]
        pushed: dict[str, Any] = {
            name: value * share for control, share in self.held.items() for name, value in PUSHED[control].items()
        }
        for index, one in enumerate(found):
            if one.hand == (self.only or one.hand):
                found[index] = replace(one, inputs=replace(one.inputs, **pushed))
        return [self.alter(one) for one in found]

    def tick(self, samples: list[HandSample] | None = None, dt: float = TICK) -> dict[str, ArmTarget]:
        self.now += dt
        if samples is None:
            samples = []
            if self.now >= self._next_sample - 1e-9:
                samples = self.samples()
                self._next_sample = self.now + PERIOD
        self.targets = self.teleop.update(samples, self.tools, self.now, self.commanded, self.obstacles, self.in_step)
        self.events += self.teleop.take_events()
        return self.targets

    def run(
        self, duration: float, move: Callable[[float], dict[str, pin.SE3]] | None = None
    ) -> list[dict[str, ArmTarget]]:
        """Tick for ``duration`` [s], and return the targets of each tick.

        ``move`` gets the time since the call [s] and returns the poses of the hands. Without ``move``, the hands rest.
        """
        start, history = self.now, []
        while self.now < start + duration - TICK / 2:
            if move is not None:
                self.hands = {**self.hands, **move(self.now + TICK - start)}
            history.append(self.tick())
        return history

    def press(self, *hands: str, button: str = "lower") -> None:
        """Press a button with each of ``hands`` for 0.15 s, and release it for 0.1 s."""
        held = self.lower if button == "lower" else self.upper
        held.update(hands)
        self.run(0.15)
        held.difference_update(hands)
        self.run(0.1)

    def push(self, control: str, hand: str = "left") -> None:
        """Push a control fully for 0.1 s, and release it for 0.1 s."""
        self.only, self.held = hand, {control: 1.0}
        self.run(0.1)
        self.held = {}
        self.run(0.1)

    def place(self, arm: str = "left") -> pin.SE3:
        """Return the target pose of an arm in the world frame. The arm must have a target."""
        target = self.targets[arm].pose
        assert target is not None
        return target

    def assert_holds(self, duration: float = 0.4) -> None:
        """Assert that both arms hold at every tick, although the hands still move."""
        for targets in self.run(duration, waving(self)):
            assert all(target.pose is None for target in targets.values())

    def refusals(self) -> set[str]:
        return {kinds(event.reason) for event in self.events if is_refusal(event)}

    def engage(self, *hands: str) -> None:
        self.run(0.05)
        self.press(*(hands or SIDES))

    @property
    def states(self) -> dict[str, str]:
        return {arm: str(state) for arm, state in self.teleop.states.items()}


def spoilt(received: HandSample, **changes: object) -> HandSample:
    """Return the sample with some of its fields replaced by invalid values."""
    return replace(received, **changes)  # type: ignore[arg-type]


History = list[dict[str, ArmTarget]]
IDLE, ENGAGED, LOST, PAUSED, HOMING, STOPPED = (
    dict.fromkeys(SIDES, state) for state in ("idle", "engaged", "lost", "paused", "homing", "stopped")
)


def operator(**changes: object) -> Operator:
    return Operator(TeleopSettings.model_validate(changes))


def engaged(**changes: object) -> Operator:
    driver = operator(**changes)
    driver.engage()
    assert driver.states == ENGAGED
    return driver


def waving(driver: Operator, speed: float = 0.2) -> Callable[[float], dict[str, pin.SE3]]:
    """Return a motion of both hands from their present poses: sideways, while they turn about z."""
    start = dict(driver.hands)
    return lambda t: {
        hand: pin.SE3(pin.exp3(np.array([0.0, 0.0, speed * t])) @ at.rotation, at.translation + sidewards(speed * t))
        for hand, at in start.items()
    }


def sidewards(way: float) -> Array:
    return np.array([0.0, way, 0.0])


def first_target(history: History, arm: str) -> pin.SE3:
    return next(pose for targets in history if (pose := targets[arm].pose) is not None)


def assert_smooth(history: History, largest: float = 0.002) -> None:
    """Assert that a target moves by less than ``largest`` [m] and 3 ``largest`` [rad] between two ticks."""
    for before, after in pairwise(history):
        for arm in SIDES:
            a, b = before[arm].pose, after[arm].pose
            if a is not None and b is not None:
                assert np.linalg.norm(b.translation - a.translation) < largest
                assert np.linalg.norm(pin.log3(a.rotation.T @ b.rotation)) < 3 * largest


PUSHED: dict[str, dict[str, Any]] = {
    "trigger": {"press_index": 1.0},
    "grip": {"press_middle": 1.0},
    "stick_up": {"thumb_stick_vertical": 1.0},
    "stick_down": {"thumb_stick_vertical": -1.0},
    "stick_left": {"thumb_stick_horizontal": -1.0},
    "stick_right": {"thumb_stick_horizontal": 1.0},
}
