"""Sessions that end in every possible way, one after the other: ``python -m tests.plants.fri.soak --sessions 1000``."""

from __future__ import annotations

import argparse
import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.fri.answers import CATCH_UP, CATCH_UP_RAMP
from q2r2_control.plants.fri.cabinet import CabinetSettings, Trip
from q2r2_control.plants.fri.cabinet_server import SimulatedArms
from q2r2_control.plants.fri.wire import CommandKind, Safety, write_monitoring
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, Array, CommandMode, HandInputs, HandSample, StepStatus
from tests.pipeline.loops import FreezingLoop
from tests.plants.fri.virtual_cabinets import VirtualCabinets

ACCELERATION = 4.0  # Acceleration of the reference [rad/s^2].
# Time that is allowed in addition to the braking time of the reference [s], and greatest speed of resting joints
# [rad/s].
_ALLOWANCE, _STILL = 0.05, 1e-3


class Rest(NamedTuple):
    """Bounds on the speed of the fastest measured joint [rad/s], at times after the reference has come to rest [s]."""

    slow_after: float
    slow: float
    settled_after: float
    settled: float


# With torques, arms settle on their springs. The slowest time constant is 0.4 s, and a held joint may creep.
_RESTS = {CommandMode.POSITION: Rest(0.0, _STILL, 0.0, _STILL), CommandMode.TORQUE: Rest(0.35, 0.2, 1.95, 0.02)}
_ENDS = ("pendant", "back at once", "safety stop", "loop freezes", "computer freezes", "cabinet freezes", "garbage")
_ASKED = {Trip.STOPPED, Trip.SAFETY}
_SILENT = 0.1  # Time after which a silent cabinet is noticed [s].
_MUTATED = 250  # Number of datagrams with wrong bytes that are sent before the session ends.


class PressingHands(ScriptedInput):
    """Hands that move in circles. Their operator presses again shortly after an arm was paused."""

    def __init__(self) -> None:
        super().__init__("circle", frequency_hz=0.5)
        self.pipeline: Pipeline | None = None
        self._since = dict.fromkeys(SIDES, 0.0)

    def poll(self, now: float) -> list[HandSample]:
        return [replace(sample, inputs=self._buttons(sample.hand, now)) for sample in super().poll(now)]

    def _buttons(self, hand: str, now: float) -> HandInputs:
        assert self.pipeline is not None
        if self.pipeline.teleop.engaged[hand]:
            self._since[hand] = now
        return HandInputs(button_lower=(now - self._since[hand]) % 0.3 > 0.2)


def make_loop(
    config: Config,
    periods: tuple[float, float] = (0.005, 0.002),
    start: Array | None = None,
    mode: CommandMode = CommandMode.POSITION,
    **network: Any,
) -> FreezingLoop:
    """Return a loop whose reference is slower than the cabinets allow, so that answers can catch up.

    The arms begin at ``start`` (nv,) [rad], by default at home. In torque mode they are simulated.
    """
    changes = {"velocity_scale": 1.0 / (1.0 + CATCH_UP), "acceleration_limit": ACCELERATION, "max_substep": 0.01}
    config = config.model_copy(update={"control": config.control.model_copy(update=changes)})
    robot = Robot.from_config(config)
    settings = {}
    for (arm, its), period in zip(robot.arms.items(), periods, strict=True):
        fastest = robot.velocity_limit[its.joints]
        settings[arm] = CabinetSettings(
            lower=tuple(robot.model.lowerPositionLimit[its.joints]),
            upper=tuple(robot.model.upperPositionLimit[its.joints]),
            velocity=tuple(fastest),
            acceleration=tuple((1.0 + CATCH_UP) ** 2 * ACCELERATION + CATCH_UP_RAMP * fastest),
            torque=tuple(robot.torque_limit[its.joints]),
            period=period,
            command=CommandKind.TORQUE if mode is CommandMode.TORQUE else CommandKind.POSITION,
        )
    hands = PressingHands()
    start = robot.home if start is None else start
    if mode is CommandMode.TORQUE:
        network.setdefault("arms", SimulatedArms(robot, config))
    plant = VirtualCabinets(robot, settings, start, 1.0 / config.nominal_rate_hz, config.control.max_substep, **network)
    hands.pipeline = made = FreezingLoop(config, robot, hands, plant, mode)
    return made


@dataclass
class Soak:
    """A soak that starts both overlays, lets the arms move for a while, and ends the session in one of many ways."""

    pipeline: FreezingLoop
    sessions: int
    seed: int = 0
    ended: int = 0
    moved: float = 0.0  # Speed of the fastest joint [rad/s].
    faults: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        assert isinstance(self.pipeline.plant, VirtualCabinets)
        self.plant, self.random = self.pipeline.plant, np.random.default_rng(self.seed)
        self._late, self._ends = {"computer freezes"}, list(_ENDS)
        if self.pipeline.drive.mode is CommandMode.TORQUE:
            # If the loop freezes, no torques come, and a session in torque mode ends by itself.
            self._late.add("loop freezes")
            # The simulated arm keeps its last torque while its cabinet stands still.
            self._ends.remove("cabinet freezes")
        self._returns = False
        self._moving_since: float | None = None
        self._lasts = 0.3
        self._rest = _RESTS[self.pipeline.drive.mode]
        self._braked_by, self._slow_by, self._start_at = math.inf, math.inf, 0.0
        # Braking times of the reference in the last 50 ms [s]. A measured arm is late: if its cabinet is silent, the
        # arm brakes from one of these earlier references.
        self._braking: deque[float] = deque(maxlen=25)
        self._seen, self._end = dict.fromkeys(SIDES, 0), "start"
        self.pipeline.listeners.append(self.look)

    def run(self) -> Soak:
        self.pipeline.run(realtime=False)
        return self

    def look(self, tick: Tick) -> None:
        """Check each tick of the loop."""
        cabinets, now = self.plant.cabinets, tick.now
        for arm, cabinet in cabinets.items():
            for trip in cabinet.trips[self._seen[arm] :]:
                if trip not in _ASKED and not (trip is Trip.LATE and self._end in self._late):
                    self.faults.append(f"{now:.3f} s, {self._end}: {arm}: {trip}")
            self._seen[arm] = len(cabinet.trips)
        speed = float(np.abs(tick.reference.v).max())
        self._braking.append(float((np.abs(tick.reference.v) / self.pipeline.controller.stop_deceleration).max()))
        self.moved = max(self.moved, speed)
        held = not any(tick.engaged.values())
        # Springs, or an arm that stopped sooner, may leave joints beyond a limit. The reference then returns and rests.
        returns = tick.reference.report.status is StepStatus.RECOVERING
        self._returns = held and (returns or (self._returns and speed > _STILL))
        still = self.pipeline.controller.settings.recovery_velocity if self._returns else _STILL
        if now > self._braked_by:
            self._braked_by = math.inf
            if held and speed > still:
                self.faults.append(f"{now:.3f} s, {self._end}: the reference moves at {speed:.4f} rad/s")
        if now > self._slow_by:
            self._look_at_rest(now, held, still)
        if now >= self._start_at:
            self._start_at, self._moving_since = math.inf, None
            for cabinet in cabinets.values():
                cabinet.safety_stop(Safety.NORMAL)
                cabinet.start_overlay()
        if all(tick.engaged.values()) and self._moving_since is None and self._slow_by == math.inf:
            self._moving_since, self._lasts = now, float(self.random.uniform(0.2, 1.2))
        if self._moving_since is not None and now - self._moving_since >= self._lasts:
            self._moving_since = None
            self._end_session(now)

    def _look_at_rest(self, now: float, held: bool, still: float) -> None:
        """Wait until the arms have settled, or until they move faster than is allowed."""
        rest, passed = self._rest, now - self._slow_by + self._rest.slow_after
        settled = passed >= rest.settled_after
        allowed = max(rest.settled if settled else rest.slow, still)
        speeds = {arm: self._fastest(arm) for arm in self.plant.cabinets} if held else {}
        for arm, fastest in speeds.items():
            if fastest > allowed:
                moves = f"{arm} moves at {fastest:.4f} rad/s, {passed:.2f} s after the reference rests"
                self.faults.append(f"{now:.3f} s, {self._end}: {moves}")
        if settled or not rest.settled < max(speeds.values(), default=0.0) <= rest.slow:
            self._slow_by = math.inf
            self._start_at = now + float(self.random.uniform(0.05, 0.3))

    def _fastest(self, arm: str) -> float:
        """Return the speed of the arm's fastest joint in the newest period [rad/s]; 0 if nobody commands it."""
        way = np.diff(self.plant.heard[arm][-2:], axis=0)
        return float(np.abs(way[np.isfinite(way)]).max(initial=0.0)) / self.plant.cabinets[arm].settings.period

    def _end_session(self, now: float) -> None:
        self.ended += 1
        if self.ended >= self.sessions:
            self.pipeline.stop()
        self._end = str(self.random.choice(self._ends))
        arm = str(self.random.choice(SIDES))
        cabinet = self.plant.cabinets[arm]
        pause = float(self.random.uniform(0.02, 0.5))
        if self._end in ("pendant", "back at once"):
            cabinet.stop()
            if self._end == "back at once":  # The overlay starts again before the arms rest.
                cabinet.start_overlay()
        elif self._end == "safety stop":
            cabinet.safety_stop(Safety.STOP_1_ON_PATH)
        elif self._end == "loop freezes":
            self.pipeline.freeze(pause)
            now += pause
        elif self._end == "computer freezes":
            self.pipeline.freeze(pause)
            self.plant.asleep_until = now + pause
            now += pause
        elif self._end == "cabinet freezes":  # The session continues, and its arm still brakes to rest.
            self.plant.stands_until[arm] = now = now + _SILENT + 4.0 * pause
        else:
            self._send_garbage()
            cabinet.stop()
        braking = max(self._braking) if self._end == "cabinet freezes" else self._braking[-1]
        self._braked_by = now + braking + _ALLOWANCE
        self._slow_by = self._braked_by + self._rest.slow_after

    def _send_garbage(self) -> None:
        """Send datagrams with wrong or missing bytes."""
        for arm, cabinet in self.plant.cabinets.items():
            whole = write_monitoring(cabinet.message)
            for _ in range(_MUTATED):
                wrong = bytearray(whole[: self.random.integers(0, len(whole) + 1)])
                for place in self.random.integers(0, max(len(wrong), 1), 3) if wrong else ():
                    wrong[place] = self.random.integers(0, 256)
                if wrong != whole:
                    self.plant.answer(arm, bytes(wrong))


def steady(pipeline: FreezingLoop, duration: float) -> bool:
    """Let sessions run for ``duration`` [s] without ending them. Return True if no session ended by itself."""
    assert isinstance(pipeline.plant, VirtualCabinets)
    cabinets = pipeline.plant.cabinets
    for cabinet in cabinets.values():
        cabinet.start_overlay()
    figures = pipeline.run(duration, realtime=False).arms
    for arm, cabinet in cabinets.items():
        error, engaged = figures[arm].position_error_mm_rms, figures[arm].engaged_s
        print(
            f"{arm}: engaged {engaged:.1f} s, error {error:.2f} mm RMS, missed {cabinet.missed}, ends {cabinet.trips}"
        )
    return not any(cabinet.trips for cabinet in cabinets.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--steady", type=float, help="no end of a session for so long [s]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mode", type=CommandMode, default=CommandMode.POSITION)
    parser.add_argument("--drift", type=float, default=200e-6, help="between the cabinets' clocks")
    parser.add_argument("--jitter", type=float, default=0.4, help="of each datagram [ms]")
    parser.add_argument("--loss", type=float, default=0.0, help="share of the datagrams, each way")
    given = parser.parse_args()
    network = {"jitter": 1e-3 * given.jitter, "drift": given.drift, "loss": given.loss, "seed": given.seed}
    periods = (0.005, 0.002) if given.steady is None else (0.005, 0.005)
    pipeline = make_loop(load_config("config/dual_iiwa7_fri.yaml"), periods, mode=given.mode, **network)
    if given.steady is not None:
        raise SystemExit(not steady(pipeline, given.steady))
    soak = Soak(pipeline, given.sessions, given.seed)
    soak.run()
    print(f"{soak.ended} sessions, fastest joint {soak.moved:.2f} rad/s, {len(soak.faults)} faults")
    print("\n".join(soak.faults[:20]))
    raise SystemExit(1 if soak.faults else 0)


if __name__ == "__main__":
    main()
