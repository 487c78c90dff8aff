"""Where does a tick of the whole live loop go, stage by stage, with each plant and mode?

Ticks come at the loop's rate, since one that comes right after another finds warmer caches. Time in the run is
simulated all the same, so that every round moves the same way whatever the machine does. The cases run in turns. Rounds
with clocks in the stages alternate with rounds without, whose whole counts. Other rounds have ticks that come right
after one another. They show the time of the program itself, whatever else the machine does while a loop sleeps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config, load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import make_plant
from q2r2_control.recording.about import About
from q2r2_control.recording.recorder import Recorder
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, CommandMode
from q2r2_control.viewer.tables import figure_table

CASES = (("kinematic", CommandMode.POSITION), ("mujoco", CommandMode.POSITION), ("mujoco", CommandMode.TORQUE))
PHYSICS, REST = "physics", "rest of the loop"
STAGES = ("inputs", "measured state", "teleop", "supervision", "control", "drive", "apply", REST, PHYSICS)
NOTES = (
    "without physics: of rounds without clocks in the stages; medians do not add up",
    "to the command: from the inputs until it is applied, a tick's time in the summary of a run",
    "back to back: without physics, where no tick waits until it is due",
    "drive: impedance and wall in torque mode; physics: of the simulator, where a real robot would move",
)
# Scripted hands move both arms at any time, once they are engaged.
TRAJECTORY, ENGAGED_AFTER = "circle", 1.0  # [s]


@dataclass(frozen=True)
class Times:
    """One stage of a tick, over all rounds."""

    median_us: float
    p99_us: float

    @classmethod
    def of(cls, times: Array) -> Times:
        """``times`` (n,) [s]."""
        return cls(1e6 * float(np.median(times)), 1e6 * float(np.percentile(times, 99)))


class StageClock:
    """Charges every moment of a run to the innermost watched method that runs, or to the rest of the loop."""

    def __init__(self, period: float) -> None:
        """``period`` [s]: a tick is held back until one is over since the last; 0: none is."""
        self._period = period
        self._due = self._last = time.perf_counter()
        self._stage = STAGES.index(REST)
        self._row = [0.0] * len(STAGES)
        self._rows: list[list[float]] = []

    @property
    def times(self) -> Array:
        """(ticks, stages) [s]."""
        return np.array(self._rows)

    @contextmanager
    def watching(self, pipeline: Pipeline, stages: bool) -> Iterator[None]:
        """Watch the plant, whose physics end a tick, and if ``stages`` all that a tick calls."""
        plant = type(pipeline.plant)
        watched: list[tuple[type, str, str]] = [(plant, "advance", PHYSICS)]
        if stages:
            watched += [
                (type(pipeline.input), "poll", "inputs"),
                (plant, "state", "measured state"),
                (type(pipeline.teleop), "update", "teleop"),
                (type(pipeline.supervisor), "tick", "supervision"),
                (type(pipeline.controller), "step", "control"),
                (type(pipeline.drive), "command", "drive"),
                (plant, "apply", "apply"),
            ]
        methods = [(owner, name, getattr(owner, name)) for owner, name, _ in watched]
        for owner, name, stage in watched:
            setattr(owner, name, self._timed(getattr(owner, name), STAGES.index(stage), stage == PHYSICS))
        try:
            yield
        finally:
            for owner, name, method in methods:
                setattr(owner, name, method)

    def _timed(self, method: Callable[..., Any], index: int, ends_tick: bool) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            before = self._enter(index)
            try:
                return method(*arguments, **options)
            finally:
                self._enter(before)
                if ends_tick:
                    self._begin_row()

        return timed

    def _enter(self, stage: int) -> int:
        now = time.perf_counter()
        before, self._stage = self._stage, stage
        self._row[before] += now - self._last
        self._last = now
        return before

    def _begin_row(self) -> None:
        self._rows.append(self._row)
        self._row = [0.0] * len(STAGES)
        self._due = max(self._due + self._period, self._last - self._period)
        if (rest := self._due - time.perf_counter()) > 0.0:
            time.sleep(rest)
        self._last = time.perf_counter()


class Case:
    """One plant and mode, and the times of its rounds so far."""

    def __init__(self, config: Config, plant: str, mode: CommandMode, ticks: int) -> None:
        self.name = f"{plant} {mode}"
        self._config, self._ticks = config, ticks
        robot = Robot.from_config(config)
        self._pipeline = Pipeline(config, robot, ScriptedInput(TRAJECTORY), make_plant(plant, robot, config), mode)
        self._times: dict[str, list[Array]] = {}
        self._to_command: list[float] = []

    def run_round(self, record: bool) -> None:
        """One run with clocks in every stage, one without, one back to back, and if asked for one that is recorded."""
        self._add("stages", self._run(stages=True))
        self._add("whole", self._run())
        self._add("back to back", self._run(paced=False))
        if record:
            with TemporaryDirectory() as folder:
                self._add("recorded", self._run(folder=Path(folder)))

    def rows(self) -> dict[str, Times]:
        """Times by what they are of."""
        found = {what: np.concatenate(times) for what, times in self._times.items()}
        stages = found.pop("stages")
        rows = {stage: Times.of(stages[:, index]) for index, stage in enumerate(STAGES) if stage != PHYSICS}
        sums = {"whole": "without physics", "recorded": "the same, recorded", "back to back": "back to back"}
        rows |= {sums[what]: Times.of(np.delete(times, -1, axis=1).sum(axis=1)) for what, times in found.items()}
        rows["to the command"] = Times(*np.median(np.reshape(self._to_command, (-1, 2)), axis=0).tolist())
        return rows | {PHYSICS: Times.of(stages[:, -1])}

    def _add(self, what: str, times: Array) -> None:
        self._times.setdefault(what, []).append(times)

    def _run(self, stages: bool = False, paced: bool = True, folder: Path | None = None) -> Array:
        pipeline, rate = self._pipeline, self._config.nominal_rate_hz
        engaged = round(ENGAGED_AFTER * rate)
        pipeline.input = ScriptedInput(TRAJECTORY, hands=tuple(pipeline.robot.arms))
        clock = StageClock(1.0 / rate if paced else 0.0)
        with nullcontext() if folder is None else Recorder(folder, "bench") as recorder:
            if recorder is not None:
                recorder.begin(About.of(pipeline, False, {}, ()), pipeline.robot)
                pipeline.listeners.append(recorder)
            with clock.watching(pipeline, stages):
                summary = pipeline.run((engaged + self._ticks) / rate, realtime=False)
            if recorder is not None:
                pipeline.listeners.remove(recorder)
        if paced and not stages and folder is None:
            self._to_command += [summary.tick_us.p50 or np.nan, summary.tick_us.p99 or np.nan]
        return clock.times[engaged : engaged + self._ticks]


def main(
    ticks: Annotated[int, typer.Option(min=100, help="Of each run.")] = 3000,
    rounds: Annotated[int, typer.Option(min=1, help="Of each case.")] = 3,
    record: Annotated[bool, typer.Option("--record", help="Also while the run is recorded.")] = False,
    json: Json = False,
) -> None:
    """Print where a tick of the live loop goes: a column for each plant and mode."""
    config = load_config(DEMO_CONFIG)
    cases = [Case(config, *case, ticks) for case in CASES]
    for turn in range(rounds):
        for case in cases:
            print_progress(f"{case.name}, round {turn + 1} of {rounds}")
            case.run_round(record)
    found = {case.name: case.rows() for case in cases}
    data = {
        "cell": config.name,
        "cases": {name: {what: asdict(times) for what, times in rows.items()} for name, rows in found.items()},
    }
    table = figure_table(
        f"{config.name}: one tick of the live loop at {config.nominal_rate_hz:g} Hz, {rounds} runs of {ticks} ticks",
        ("median / p99", *(f"{name} [us]" for name in found)),
        (
            (what, *(f"{rows[what].median_us:.0f} / {rows[what].p99_us:.0f}" for rows in found.values()))
            for what in next(iter(found.values()))
        ),
        NOTES,
    )
    print_report(data, (table,), json)


if __name__ == "__main__":
    typer.run(main)
