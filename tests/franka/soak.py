"""Sessions of two simulated FR3 that end in every possible way: ``python -m tests.franka.soak --sessions 1000``.

The real client library talks to franka-sim, which ends a motion by a reflex if a command violates the limits that it
knows. Every command is checked against the published limits as well.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import PlantError
from q2r2_control.inputs.scripted import ScriptedInput, trajectory_named
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, CommandMode, HandInputs, HandSample
from q2r2_control.wording import sentence
from tests.franka.simulated_arms import ADDRESSES, ROOT, SimulatedArm, why_not

CELL = ROOT / "plugins/q2r2_franka/dual_fr3.yaml"
ENDS = ("reflex", "user stop", "loop stalls", "robot freezes", "power loss")
_MOVES = 0.8  # Time from the engagement until the session ends [s].
_PATIENCE = 20.0  # Longest time until both arms are engaged again [s].
_STOPPED = 0.5  # Duration of a user stop [s].
_STALLS = 0.02, 0.5  # Shortest and longest stall [s].
_PRIORITY = 5  # Real-time priority of the loop and of the simulated robots.
_LOST = "communication_constraints_violation"


@dataclass
class Report:
    """What happened in all sessions."""

    sessions: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    failure: str = ""  # The reason why the sessions ended too early; empty if they did not.


class Operator(ScriptedInput):
    """Hands that move in circles. Their operator presses again after a pause. ``ends`` lists how the sessions end."""

    def __init__(
        self, arms: Mapping[str, SimulatedArm], sessions: int, ends: tuple[str, ...], seed: int, trajectory: str
    ) -> None:
        super().__init__(trajectory or "circle", frequency_hz=0.5)
        self._only_follows = bool(trajectory)
        self.pipeline: Pipeline | None = None
        self.report = Report()
        self._arms, self._sessions, self._ends, self._random = arms, sessions, ends, random.Random(seed)
        self._paused = dict.fromkeys(SIDES, 0.0)
        self._moves_since: float | None = None
        self._last_good: float | None = None

    def poll(self, now: float) -> list[HandSample]:
        self._operate(now)
        return [replace(sample, inputs=self._pressed(sample, now)) for sample in super().poll(now)]

    def _pressed(self, sample: HandSample, now: float) -> HandInputs:
        assert self.pipeline is not None
        if self.pipeline.teleop.engaged[sample.hand]:
            self._paused[sample.hand] = now
        return replace(sample.inputs, button_lower=(now - self._paused[sample.hand]) % 0.4 > 0.2)

    def _operate(self, now: float) -> None:
        assert self.pipeline is not None
        self._last_good = now if self._last_good is None else self._last_good
        if not all(self.pipeline.teleop.engaged.values()):
            self._moves_since = None
            if now - self._last_good > _PATIENCE:
                self.report.failure = f"no arm was engaged after {dict(self.report.ends)}"
                self.pipeline.stop()
            return
        self._last_good = now
        self._moves_since = now if self._moves_since is None else self._moves_since
        if self._only_follows or now - self._moves_since < _MOVES:
            return
        if self.report.sessions == self._sessions:
            self.pipeline.stop()
            return
        self._moves_since = None
        end = self._ends[self.report.sessions % len(self._ends)]
        self.report.sessions += 1
        self.report.ends[end] += 1
        print(f"session {self.report.sessions} of {self._sessions}: {end}", file=sys.stderr)
        self._end(end, self._arms[self._random.choice(SIDES)])

    def _end(self, how: str, arm: SimulatedArm) -> None:
        stall = self._random.uniform(*_STALLS)
        if how == "loop stalls":
            time.sleep(stall)
        elif how == "reflex":
            arm.ask("reflex")
        elif how == "user stop":
            arm.ask("user stop")
            _later(_STOPPED, lambda: arm.ask("user stop ends"))
        elif how == "robot freezes":
            os.kill(arm.pid, signal.SIGSTOP)
            _later(stall, lambda: os.kill(arm.pid, signal.SIGCONT))
        else:
            assert self.pipeline is not None
            standing = self.pipeline.plant.state().q[self.pipeline.robot.arms[arm.name].joints]
            arm.kill()
            threading.Thread(target=arm.start, args=(standing,)).start()


def _later(wait: float, do: Callable[[], None]) -> None:
    """Call ``do`` in another thread after a ``wait`` [s] by the slow clock."""

    def run() -> None:
        time.sleep(wait)
        do()

    threading.Thread(target=run).start()


def cell(record: Path, mode: CommandMode) -> Config:
    """Return the shipped cell with the addresses of the simulated arms."""
    config = load_config(CELL)
    franka = dict(config.plant_settings["franka"])
    for arm, address in ADDRESSES.items():
        franka[arm] = franka[arm] | {"address": address}
    franka |= {"real_time": "ignore", "record": str(record)}
    return config.model_copy(update={"plant_settings": {"franka": franka}})


def run(
    sessions: int, mode: CommandMode, ends: tuple[str, ...], seed: int, slowness: float, folder: Path, trajectory: str
) -> dict[str, object]:
    """Run the sessions, and return what happened as JSON."""
    from q2r2_franka.check import check_commands
    from q2r2_franka.plant import FrankaPlant
    from q2r2_franka.record import entries_of

    config = cell(folder / "commands.bin", mode)
    arms = {str(arm): SimulatedArm(arm, its.home, folder, slowness) for arm, its in config.arms.items()}
    try:
        robot = Robot.from_config(config)
        plant = FrankaPlant(robot, config)
        plant.longest_wait = plant.longest_session_wait = 60.0
        operator = Operator(arms, sessions, ends, seed, trajectory)
        operator.pipeline = pipeline = Pipeline(config, robot, operator, plant, mode)
        duration = trajectory_named(trajectory).duration if trajectory else None
        try:
            summary = pipeline.run(duration, realtime=True)
            distance = summary.min_distance_mm
            errors = {arm: its.position_error_mm_rms for arm, its in summary.arms.items()}
            pauses = Counter(sentence(event.reason) for event in summary.events if event.source == "engaged")
            engaged = {arm: its.engaged_s for arm, its in summary.arms.items()}
        except PlantError as error:
            operator.report.failure, distance, errors, engaged = str(error), None, {}, {}
            pauses = Counter[str]()
    finally:
        for arm in arms.values():
            arm.kill()
    checked = check_commands(entries_of(folder / "commands.bin"))
    reflexes = [line for arm in arms.values() for line in arm.reflexes]
    return {
        "sessions": operator.report.sessions,
        "ends": dict(operator.report.ends),
        "failure": operator.report.failure,
        "lost_commands": sum(_LOST in line for line in reflexes),
        "reflexes": [line for line in reflexes if _LOST not in line],
        "min_distance_mm": distance,
        "position_error_mm_rms": errors,
        "engaged_s": engaged,
        "pauses": dict(pauses),
        "commands": {arm: its.commands for arm, its in checked.items()},
        "motions": {arm: its.motions for arm, its in checked.items()},
        "shares": {arm: its.shares for arm, its in checked.items()},
        "violated": {arm: its.violated for arm, its in checked.items()},
    }


def run_slowly(*arguments: str, slowness: float) -> dict[str, object]:
    """Run this module in a process with a slow clock, and return its JSON."""
    clock = str(Path(__file__).with_name("slow_clock"))
    path = os.pathsep.join([clock, *(os.path.abspath(folder) for folder in sys.path)])
    environment = os.environ | {"PYTHONPATH": path, "SLOWNESS": str(slowness)}
    command = [sys.executable, "-m", __name__ if __name__ != "__main__" else "tests.franka.soak", *arguments, "--json"]
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    assert done.returncode == 0, f"exit code {done.returncode}; standard error has the reason"
    found: dict[str, object] = json.loads(done.stdout.splitlines()[-1])
    return found


def schedule_first() -> None:
    """Let this process and its children run before other programs, if this is permitted.

    A robot has a computer of its own. Without this priority, other programs delay the simulated robots.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_PRIORITY))
    except PermissionError:
        print("real-time priority is not permitted: let no other program run meanwhile", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--mode", type=CommandMode, default=CommandMode.TORQUE, choices=["torque", "position"])
    parser.add_argument("--ends", nargs="+", default=ENDS, choices=ENDS)
    parser.add_argument("--trajectory", default="", help="scripted hands that are followed once, in place of sessions")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slowness", type=float, default=1.0, help="seconds that a second of all clocks takes")
    parser.add_argument("--json", action="store_true", help="run at once, with the clock as it is")
    given = parser.parse_args()
    if missing := why_not():
        parser.error(missing)
    schedule_first()
    if given.slowness != 1.0 and not given.json:
        found = run_slowly(*sys.argv[1:], slowness=given.slowness)
        print(json.dumps(found, indent=1))
        return
    slowness = float(os.environ.get("SLOWNESS", "1"))
    with tempfile.TemporaryDirectory() as folder:
        found = run(given.sessions, given.mode, tuple(given.ends), given.seed, slowness, Path(folder), given.trajectory)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
