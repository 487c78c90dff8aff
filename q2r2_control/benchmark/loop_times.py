"""Where a tick of the whole live loop goes: the product's own :class:`Pipeline`, with clocks put into it.

Ticks come at the loop's rate, since one that comes right after another finds warmer caches; time in the run is
simulated all the same, so every round moves the same way whatever the machine does. The cases run in turns, and rounds
with clocks in the stages alternate with rounds that have them only around tick and physics, which tell the whole, and
with rounds whose ticks come right after one another: what the program itself takes, whatever else the machine does
while a loop sleeps.

What recording costs is less than a machine's speed changes within a minute. So runs with and without it come in pairs,
next to each other and in changing order, and the ratio of their times has an interval: the pairs are drawn again and
again, as many as there are, with replacement (Efron, Bootstrap methods, Annals of Statistics 7, 1979).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.benchmark.stage_clock import PHYSICS, STAGES, StageClock
from q2r2_control.benchmark.tick_times import FEWEST_TICKS
from q2r2_control.config.cell import Config
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.pipeline.pipeline_run import PipelineRun
from q2r2_control.plants.factory import make_plant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.about import About
from q2r2_control.recording.recorder import Recorder
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, CommandMode

CASES = (
    ("kinematic", CommandMode.POSITION),
    ("mujoco", CommandMode.POSITION),
    ("mujoco", CommandMode.TORQUE),
)
_ROUNDS = 3
_PAIRS = 10  # of runs with and without recording
_DRAWS = 1000
# Scripted hands move both arms at any time, once they are engaged.
_TRAJECTORY, _ENGAGED_AFTER = "circle", 1.0  # [s]


@dataclass(frozen=True, slots=True)
class StageTime:
    """Time of one stage of a tick, over all rounds."""

    stage: str
    median_us: float
    p99_us: float


class Ratio(NamedTuple):
    """Of two times, and the interval of 90 % of what other draws of the pairs give."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class RecordingCost:
    """The same times of runs that are recorded to a file, and how many times as long their p99 is."""

    without_physics: StageTime
    to_command: StageTime
    p99_ratio: Ratio  # of ticks without physics
    to_command_p99_ratio: Ratio


@dataclass(frozen=True, slots=True)
class LoopRow:
    """One plant and mode of driving."""

    plant: str
    mode: str
    ticks: int  # timed, of a round
    rounds: int
    stages: list[StageTime]  # of the first three rounds
    without_physics: StageTime  # of rounds without clocks in the stages
    to_command: StageTime  # the same, until the command is applied: a tick's time in the summary of a run
    back_to_back: StageTime  # without physics, of ticks that come right after one another
    clocks_us: float  # that the clocks in the stages add to a tick
    recording: RecordingCost | None = None


@dataclass(frozen=True, slots=True)
class LoopReport:
    """All plants and modes on one cell."""

    cell: str
    loop_rate_hz: float
    rows: list[LoopRow]

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``."""
        return asdict(self)


def run_loop_bench(
    config: Config,
    ticks: int,
    progress: Callable[[str], None] = lambda what: None,
    *,
    paced: bool = True,
    record: bool = False,
) -> LoopReport:
    """Time ``ticks`` ticks of each case and round, with both arms engaged.

    ``record``: time them also while they are recorded, with the cell's cameras where MuJoCo is. ``paced``: ticks begin
    a period apart; otherwise each right after the last, which is faster and tells less. Raises :class:`ConfigError` for
    fewer than 100 ticks, and for a cell that cannot be built, and :class:`PlantError` where no pictures can be taken.
    """
    if ticks < FEWEST_TICKS:
        raise ConfigError(f"bench: ticks = {ticks}: allowed: {FEWEST_TICKS} or more")
    cases = [_Case(config, plant, mode, ticks, paced, record) for plant, mode in CASES]
    rounds = _PAIRS if record else _ROUNDS
    for turn in range(rounds):
        for case in cases:
            progress(f"{case.plant}, {case.mode}, round {turn + 1} of {rounds}")
            case.run_round(turn)
    return LoopReport(config.name, config.loop_rate_hz, [case.row() for case in cases])


class _ClockedPipeline(Pipeline):
    """Its runs have the clocks of ``stage_clock``, in every stage or only around the physics."""

    stage_clock: StageClock
    clocks_in_stages: bool
    compute_times: list[float]  # of each tick, until its command is applied [s]

    def _begin(self, realtime: bool) -> PipelineRun:
        run, clock = super()._begin(realtime), self.stage_clock
        self.compute_times, record = [], run.record

        def noted(*tick: Any) -> None:
            self.compute_times.append(tick[-1])
            record(*tick)

        setattr(run, "record", noted)  # noqa: B010, as the clocks are put in
        clock.watch_ticks(run, "tick")
        clock.watch(self.plant, "advance", PHYSICS)
        if not self.clocks_in_stages:
            return run
        clock.watch(self.input, "poll", "inputs")
        clock.watch(self.plant, "state", "measured state")
        clock.watch(run, "tools", "measured state")
        clock.watch(self.teleop, "update", "teleop")
        for name in ("take_joint_state", "take_target", "release_target", "tick"):
            clock.watch(self.supervisor, name, "supervision")
        clock.watch(run, "limit_grippers", "supervision")
        for name in ("step", "tool_pose", "set_opening", "set_holding"):
            clock.watch(self.controller, name, "control")
        clock.watch(self.drive, "command", "drive")
        clock.watch(self.plant, "apply", "apply")
        clock.watch(run, "record", "recording")
        return run


class _Case:
    """One plant and mode, and the times of its rounds so far."""

    def __init__(self, config: Config, plant: str, mode: CommandMode, ticks: int, paced: bool, record: bool) -> None:
        self.plant, self.mode, self._record = plant, str(mode), record
        self._config, self._ticks = config, ticks
        self._period = 1.0 / config.loop_rate_hz if paced else 0.0
        robot = Robot.from_config(config)
        self._pipeline = _ClockedPipeline(
            config, robot, ScriptedInput(_TRAJECTORY), make_plant(plant, robot, config), mode
        )
        self._stages: list[Array] = []
        self._whole: list[Array] = []
        self._back_to_back: list[Array] = []
        self._recorded: list[Array] = []
        self._to_command: list[Array] = []
        self._to_command_recorded: list[Array] = []

    def run_round(self, number: int) -> None:
        """One run with clocks in every stage, one without and one back to back, and where asked for one recorded."""
        if number < _ROUNDS:
            self._stages.append(self._run(clocks_in_stages=True))
            self._back_to_back.append(self._run(clocks_in_stages=False, paced=False))
        runs = [self._run_plainly, self._run_recorded] if self._record else [self._run_plainly]
        for run in runs if number % 2 == 0 else reversed(runs):
            run()

    def row(self) -> LoopRow:
        """The figures of all rounds."""
        stages, whole = np.concatenate(self._stages), _without_physics(np.concatenate(self._whole))
        beside = whole[: len(stages)]  # of the same rounds
        return LoopRow(
            plant=self.plant,
            mode=self.mode,
            ticks=self._ticks,
            rounds=len(self._whole),
            stages=[_time_of(stage, stages[:, index]) for index, stage in enumerate(STAGES)],
            without_physics=_time_of("without physics", whole),
            to_command=_time_of("to the command", np.concatenate(self._to_command)),
            back_to_back=_time_of("back to back", _without_physics(np.concatenate(self._back_to_back))),
            clocks_us=1e6 * float(np.median(_without_physics(stages)) - np.median(beside)),
            recording=self._recording_cost() if self._record else None,
        )

    def _recording_cost(self) -> RecordingCost:
        plain, recorded = ([_without_physics(run) for run in runs] for runs in (self._whole, self._recorded))
        return RecordingCost(
            _time_of("recorded", np.concatenate(recorded)),
            _time_of("to the command, recorded", np.concatenate(self._to_command_recorded)),
            _p99_ratio(recorded, plain),
            _p99_ratio(self._to_command_recorded, self._to_command),
        )

    def _run_plainly(self) -> None:
        self._whole.append(self._run(clocks_in_stages=False))
        self._to_command.append(self._compute_times())

    def _run_recorded(self) -> None:
        """As when a robot moves: where there is no room ticks are lost, so that nothing can hold up the loop."""
        pipeline = self._pipeline
        plant = pipeline.plant
        cameras = self._config.simulated_cameras if isinstance(plant, MujocoPlant) else {}
        with TemporaryDirectory() as folder, Recorder(Path(folder), "bench", pictures=bool(cameras)) as recorder:
            if isinstance(plant, MujocoPlant) and cameras:
                recorder.prepare(plant, pipeline.robot, cameras)
            recorder.begin(About.of(pipeline, True, {}, tuple(cameras)), pipeline.robot)
            pipeline.listeners.append(recorder)
            try:
                self._recorded.append(self._run(clocks_in_stages=False))
                self._to_command_recorded.append(self._compute_times())
            finally:
                pipeline.listeners.remove(recorder)
                if fault := recorder.summary.pictures_fault:
                    raise PlantError(f"no pictures: {fault}")

    def _run(self, clocks_in_stages: bool, paced: bool = True) -> Array:
        pipeline, engaged = self._pipeline, round(_ENGAGED_AFTER * self._config.loop_rate_hz)
        pipeline.input = ScriptedInput(_TRAJECTORY, hands=tuple(pipeline.robot.arms))
        pipeline.stage_clock = StageClock(self._period if paced else 0.0)
        pipeline.clocks_in_stages = clocks_in_stages
        try:
            # One more, since the last one's end is the next one's begin.
            pipeline.run((engaged + self._ticks + 1) / self._config.loop_rate_hz, realtime=False)
        finally:
            pipeline.stage_clock.release()
        return pipeline.stage_clock.times[engaged : engaged + self._ticks]

    def _compute_times(self) -> Array:
        """Of the last run, of the ticks that count."""
        engaged = round(_ENGAGED_AFTER * self._config.loop_rate_hz)
        return np.array(self._pipeline.compute_times[engaged : engaged + self._ticks])


def _without_physics(times: Array) -> Array:
    return times.sum(axis=1) - times[:, STAGES.index(PHYSICS)]


def _time_of(stage: str, times: Array) -> StageTime:
    return StageTime(stage, 1e6 * float(np.median(times)), 1e6 * float(np.percentile(times, 99)))


def _p99_ratio(runs: list[Array], others: list[Array]) -> Ratio:
    """Of the times of ``runs`` to those of ``others``, each of which was next to one of them."""
    pairs, random = np.array([others, runs]), np.random.default_rng(0)

    def ratio(chosen: npt.NDArray[np.int64]) -> float:
        other, one = np.percentile(pairs[:, chosen], 99, axis=(1, 2))
        return float(one / other)

    count = len(runs)
    drawn = [ratio(random.integers(0, count, count)) for _ in range(_DRAWS)]
    low, high = np.percentile(drawn, (5, 95))
    return Ratio(ratio(np.arange(count)), float(low), float(high))
