"""How long does each stage of a tick of the whole live loop take, with each plant and mode?

Ticks come at the loop's rate, because a tick would find warmer caches if it followed the previous tick at once. Time in
the run is still simulated, so the arms make the same motion in every round, on a busy machine too. The cases run in
turns. Rounds that time each stage alternate with rounds that time only the whole tick. In a third kind of round, each
tick follows the previous tick at once. Such rounds show the time of the program itself: the loop does not sleep between
ticks, so no other program can change the caches.
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
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
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
    "without physics: Time of a tick in rounds that do not time the stages. Medians of stages do not add up to it.",
    "to the command: Time from the inputs until the command is applied, as the summary of a run has it.",
    "back to back: Time of a tick without physics, in rounds in which no tick waits until it is due.",
    "drive: Impedance and wall in torque mode.",
    "physics: Time of the simulator, during which a real robot would move.",
)
TRAJECTORY, ENGAGED_AFTER_S = "circle", 1.0  # Both arms are engaged and move without a pause after this time [s].


@dataclass(frozen=True)
class Times:
    """The times of one stage of a tick, over all rounds."""

    median_us: float
    p99_us: float

    @classmethod
    def of(cls, times: Array) -> Times:
        """Return the figures of ``times`` (n,) [s]."""
        return cls(1e6 * float(np.median(times)), 1e6 * float(np.percentile(times, 99)))


class StageClock:
    """Measures how long each stage of a tick takes.

    While a watched method runs, the time counts for the stage of this method. If one watched method calls another, the
    time counts for the inner method. All other time counts for the stage :data:`REST`.
    """

    def __init__(self, period: float) -> None:
        """``period`` is the least time between the starts of two ticks [s]. If it is 0, no tick waits."""
        self._period = period
        self._due = self._last = time.perf_counter()
        self._stage = STAGES.index(REST)
        self._row = [0.0] * len(STAGES)
        self._rows: list[list[float]] = []

    @property
    def times(self) -> Array:
        """The time of each stage in each tick (ticks, stages) [s]."""
        return np.array(self._rows)

    @contextmanager
    def watching(self, pipeline: Pipeline, stages: bool) -> Iterator[None]:
        """Watch the plant's physics, with which a tick ends. If ``stages`` is True, also watch all other stages."""
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
    """One plant and mode, with the times of its rounds so far."""

    def __init__(self, config: Config, plant: str, mode: CommandMode, ticks: int) -> None:
        self.name = f"{plant} {mode}"
        self._config, self._ticks = config, ticks
        robot = Robot.from_config(config)
        self._pipeline = Pipeline(config, robot, ScriptedInput(TRAJECTORY), make_plant(plant, robot, config), mode)
        self._times: dict[str, list[Array]] = {}
        self._to_command: list[float] = []

    def run_round(self, record: bool) -> None:
        """Run once with every stage timed, once with only the whole tick timed, and once without pauses between ticks.

        If ``record`` is True, run once more with a recording.
        """
        self._add("stages", self._run(stages=True))
        self._add("whole", self._run())
        self._add("back to back", self._run(paced=False))
        if record:
            with TemporaryDirectory() as folder:
                self._add("recorded", self._run(folder=Path(folder)))

    def rows(self) -> dict[str, Times]:
        """Return the times of each row of the table, with the name of the row."""
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
        engaged = round(ENGAGED_AFTER_S * rate)
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
    ticks: Annotated[int, typer.Option(min=100, help="Number of ticks of each run.")] = 3000,
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds of each case.")] = 3,
    record: Annotated[bool, typer.Option("--record", help="Also time runs that are recorded.")] = False,
    json: Json = False,
) -> None:
    """Print how long each stage of a tick of the live loop takes, with a column for each plant and mode."""
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
        f"{config.name}: One tick of the live loop at {config.nominal_rate_hz:g} Hz, {rounds} runs of {ticks} ticks",
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
