"""Measure how near two arms that swing side by side come to each other if one of them lags or stops.

``python -m tests.plants.fri.skewed_arms`` prints a table.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.inputs.scripted import START, HandTrajectory, ScriptedInput
from q2r2_control.plants.fri.cabinet_server import settings_of
from q2r2_control.plants.fri.wire import CommandKind
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, Array
from q2r2_control.wording import sentence
from tests.pipeline.loops import FreezingLoop
from tests.plants.fri.virtual_cabinets import VirtualCabinets

CASES = ("nothing", "answers 0.25 s apart", "cable pulled", "pendant stopped")
_AMPLITUDE = 0.12  # Amplitude of the tools' common sideways motion [m].
_HEIGHT = 0.45  # Height of the tools [m].


@dataclass
class Outcome:
    """The result of a run. Each distance is the least distance between bodies of different arms [m]."""

    speed: float  # Largest speed of both tools before the incident [m/s].
    reference: float
    measured: float
    rest: float  # Time from the incident until both measured arms rested [s].
    margin: float  # Margin of the measured arms: distance minus the kept distance [m].
    error: float  # Error of the measured tools before the incident [m RMS].
    events: list[str]


def side_by_side(config: Config, robot: Robot, apart: float) -> Array:
    """Return a posture (nv,) [rad] in which both tools point down, ``apart`` [m] along the world's y."""
    controller = CartesianController(robot, config.control.timed(False))
    targets = {}
    for arm, y in zip(SIDES, (0.5 * apart, -0.5 * apart), strict=True):
        turned = controller.tool_pose(arm).rotation
        targets[arm] = pin.SE3(turned, np.array([0.55, y, _HEIGHT]))
    for _ in range(400):
        q = controller.step(targets, 0.01).q
    return q


class Case:
    """A run in which both hands swing sideways. One arm is delayed, cut off or stopped when its speed is greatest."""

    def __init__(
        self,
        case: str,
        speed: float,
        config: Config | None = None,
        period: float = 0.005,
        apart: float = 0.2,
    ) -> None:
        """The tools have ``speed`` [m/s] in the middle of the swing to the left, when the left arm is in front."""
        config = config or load_config("config/dual_iiwa7_fri.yaml")
        robot = Robot.from_config(config)
        start = side_by_side(config, robot, apart)
        settings = {its: settings_of(robot, its, CommandKind.POSITION, 2, period) for its in robot.arms}
        rate, longest = config.nominal_rate_hz, config.control.max_substep
        self.plant = VirtualCabinets(robot, settings, start, 1.0 / rate, longest)
        frequency = speed / (2.0 * math.pi * _AMPLITUDE)
        path = HandTrajectory(_swing, _swing)
        hands = ScriptedInput(path, frequency_hz=frequency)
        self.loop = FreezingLoop(config, robot, hands, self.plant)
        self.loop.listeners.append(self._look)
        self.plant.on_message = lambda arm, t: self._measure(t)
        self.robot, self._case, self._arm = robot, case, "left"
        self._happens = START + math.ceil(frequency) / frequency
        self._kept = np.array(self.loop.controller.kept_distances)
        self._between = np.array([i for i in range(len(self._kept)) if _moves_both(robot, i)])
        self.outcome = Outcome(0.0, np.inf, np.inf, 0.0, np.inf, 0.0, [])
        self._errors: list[float] = []
        self._last: Array | None = None

    def run(self, duration: float = 0.8) -> Outcome:
        """Run until ``duration`` [s] after the incident."""
        for cabinet in self.plant.cabinets.values():
            cabinet.start_overlay()
        summary = self.loop.run(self._happens + duration, realtime=False)
        self.outcome.events = [f"{event.t - self._happens:.3f} s: {sentence(event.reason)}" for event in summary.events]
        self.outcome.error = math.sqrt(np.mean(np.square(self._errors)))
        return self.outcome

    def _look(self, tick: Tick) -> None:
        if tick.t < self._happens - 0.5:
            return
        found = self.outcome
        distances = self.robot.distance_values(tick.reference.q)[self._between]
        found.reference = min(found.reference, float(distances.min()))
        if tick.t < self._happens:
            if tick.t > self._happens - 0.4:
                for arm, target in tick.targets.items():
                    if target.command is not None:
                        self._errors.append(
                            float(np.linalg.norm(target.command.translation - tick.tools[arm].translation))
                        )
            J = pin.computeFrameJacobian(
                self.robot.model,
                self.robot.model.createData(),
                tick.state.q,
                self.robot.arms["left"].frame_id,
                pin.LOCAL_WORLD_ALIGNED,
            )
            found.speed = max(found.speed, float(np.linalg.norm(J[:3] @ tick.state.v)))
        if self._case == "answers 0.25 s apart":
            for pause in (0.36, 0.24, 0.12):
                if self._happens - pause <= tick.t < self._happens - pause + 0.001:
                    self.plant.stands_until[self._arm] = tick.now + 0.09
        if tick.t >= self._happens:
            self._happen()

    def _happen(self) -> None:
        case, self._case = self._case, "nothing"
        if case == "pendant stopped":
            self.plant.cabinets[self._arm].stop()
        elif case == "cable pulled":
            self.plant.unplugged.add(self._arm)

    def _measure(self, t: float) -> None:
        """Measure the distances of the arms at the positions that their cabinets measure."""
        if t < self._happens - 0.1:
            return
        q = np.zeros(self.robot.model.nv)
        for arm, cabinet in self.plant.cabinets.items():
            q[self.robot.arms[arm].joints] = cabinet.arm.q
        distances = self.robot.distance_values(q)[self._between]
        found = self.outcome
        found.measured = min(found.measured, float(distances.min()))
        found.margin = min(found.margin, float((distances - self._kept[self._between]).min()))
        if self._last is not None and t > self._happens and np.abs(q - self._last).max() > 1e-9:
            found.rest = t - self._happens
        self._last = q


def _moves_both(robot: Robot, pair: int) -> bool:
    """Return whether the bodies of a pair are parts of different arms."""
    geometry, model = robot.collision_model, robot.model
    bodies = geometry.collisionPairs[pair].first, geometry.collisionPairs[pair].second
    owners = []
    for body in bodies:
        moving = {model.idx_vs[joint] for joint in model.supports[geometry.geometryObjects[body].parentJoint] if joint}
        owners.append({arm for arm, its in robot.arms.items() if moving.intersection(its.joints)})
    return bool(owners[0] and owners[1] and not owners[0] & owners[1])


def _swing(t: float, frequency: float) -> tuple[Array, Array]:
    """Return the offset of both tools at ``t`` [s]: a swing along the world's y, which grows in the first second."""
    phase = 2.0 * math.pi * frequency * max(t - START, 0.0)
    share = min(max(t - START, 0.0), 1.0)
    return np.array([0.0, share * _AMPLITUDE * math.sin(phase), 0.0]), np.zeros(3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--apart", type=float, default=0.15, help="the tools at the start [m]")
    parser.add_argument("--period", type=float, default=5.0, help="of the cabinets' messages [ms]")
    parser.add_argument("--speeds", type=float, nargs="*", default=[0.25, 0.5, 0.8], help="of the tools [m/s]")
    given = parser.parse_args()
    names = ("speed", "error", "reference", "measured", "margin")
    print(f"{'case':22}{'asked':>7}" + "".join(f"{name:>10}" for name in names) + f"{'rest':>8}")
    for speed in given.speeds:
        for case in CASES:
            found = Case(case, speed, period=1e-3 * given.period, apart=given.apart).run()
            lengths = (found.error, found.reference, found.measured, found.margin)
            figures = "".join(f"{1e3 * value:10.1f}" for value in lengths)
            after = [event for event in found.events if not event.startswith("-")]
            print(f"{case:22}{speed:7.2f}{found.speed:10.2f}{figures}{found.rest:8.3f}  {after[:1]}", flush=True)


if __name__ == "__main__":
    main()
