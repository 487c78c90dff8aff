"""Where a tick of the whole live loop goes: the product's own :class:`Pipeline`, with clocks put into it.

Ticks come at the loop's rate, since one that comes right after another finds warmer caches; time in the run is
simulated all the same, so every round moves the same way whatever the machine does. The cases run in turns, and rounds
with clocks in the stages alternate with rounds that have them only around tick and physics, which tell the whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from q2r2_control.benchmark.tick_times import FEWEST_TICKS
from q2r2_control.config import Config
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline import Pipeline, PipelineRun
from q2r2_control.plants.factory import make_plant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.about import About
from q2r2_control.recording.recorder import Recorder
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, CommandMode

PHYSICS, REST = "physics", "rest of the loop"
STAGES = ("inputs", "measured state", "teleop", "supervision", "control", "drive", "apply", "recording", REST, PHYSICS)
CASES = (
    ("kinematic", CommandMode.POSITION),
    ("mujoco", CommandMode.POSITION),
    ("mujoco", CommandMode.TORQUE),
)
_ROUNDS = 3
# Scripted hands move both arms at any time, once they are engaged.
_TRAJECTORY, _ENGAGED_AFTER = "circle", 1.0  # [s]


@dataclass(frozen=True, slots=True)
class StageTime:
    """Time of one stage of a tick, over all rounds."""

    stage: str
    median_us: float
    p99_us: float


@dataclass(frozen=True, slots=True)
class LoopRow:
    """One plant and mode of driving."""

    plant: str
    mode: str
    ticks: int  # timed, of a round
    rounds: int
    stages: list[StageTime]
    without_physics: StageTime  # of rounds without clocks in the stages
    to_command: StageTime  # the same, until the command is applied: a tick's time in the summary of a run
    clocks_us: float  # that the clocks in the stages add to a tick
    recorded: StageTime | None = None  # without physics, of rounds that were recorded to a file
    to_command_recorded: StageTime | None = None


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
    for turn in range(_ROUNDS):
        for case in cases:
            progress(f"{case.plant}, {case.mode}, round {turn + 1} of {_ROUNDS}")
            case.run_round()
    return LoopReport(config.name, config.loop_rate_hz, [case.row() for case in cases])


class StageClock:
    """Charges every moment of a run to the innermost watched function that runs, or to :data:`REST`."""

    def __init__(self, period: float = 0.0) -> None:
        """``period`` [s]: ticks are held back until one is over since the last."""
        self._period = period
        self._due = self._last = time.perf_counter()
        self._stage = STAGES.index(REST)
        self._row = [0.0] * len(STAGES)
        self._rows: list[list[float]] = []
        self._watched: list[tuple[object, str]] = []

    @property
    def times(self) -> Array:
        """(ticks, stages) [s]; what came before the first tick is left out."""
        return np.array(self._rows[1:])

    def watch(self, owner: object, name: str, stage: str) -> None:
        """Charge calls of a method of ``owner`` to ``stage``, until :meth:`release`."""
        method, index = getattr(owner, name), STAGES.index(stage)

        def timed(*arguments: Any, **options: Any) -> Any:
            before = self._turn_to(index)
            try:
                return method(*arguments, **options)
            finally:
                self._turn_to(before)

        setattr(owner, name, timed)
        self._watched.append((owner, name))

    def watch_ticks(self, owner: object, name: str) -> None:
        """Begin a row at every call of a method of ``owner``."""
        method = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            self._begin_row()
            return method(*arguments, **options)

        setattr(owner, name, timed)
        self._watched.append((owner, name))

    def release(self) -> None:
        """Leave all owners as they were."""
        for owner, name in self._watched:
            delattr(owner, name)
        self._watched.clear()

    def _turn_to(self, stage: int) -> int:
        now = time.perf_counter()
        before, self._stage = self._stage, stage
        self._row[before] += now - self._last
        self._last = now
        return before

    def _begin_row(self) -> None:
        self._turn_to(self._stage)
        self._rows.append(self._row)
        self._row = [0.0] * len(STAGES)
        self._due = max(self._due + self._period, self._last - self._period)
        if (rest := self._due - time.perf_counter()) > 0.0:
            time.sleep(rest)
        self._last = time.perf_counter()


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
        self._recorded: list[Array] = []
        self._to_command: list[Array] = []
        self._to_command_recorded: list[Array] = []

    def run_round(self) -> None:
        """One run with clocks in every stage, one without, and where asked for one that is recorded."""
        self._stages.append(self._run(clocks_in_stages=True))
        self._whole.append(self._run(clocks_in_stages=False))
        self._to_command.append(self._compute_times())
        if self._record:
            self._recorded.append(self._run_recorded())
            self._to_command_recorded.append(self._compute_times())

    def row(self) -> LoopRow:
        """The figures of all rounds."""
        stages, whole = np.concatenate(self._stages), _without_physics(np.concatenate(self._whole))
        return LoopRow(
            plant=self.plant,
            mode=self.mode,
            ticks=self._ticks,
            rounds=len(self._stages),
            stages=[_time_of(stage, stages[:, index]) for index, stage in enumerate(STAGES)],
            without_physics=_time_of("without physics", whole),
            to_command=_time_of("to the command", np.concatenate(self._to_command)),
            clocks_us=1e6 * float(np.median(_without_physics(stages)) - np.median(whole)),
            **self._while_recorded(),
        )

    def _while_recorded(self) -> dict[str, StageTime]:
        if not self._record:
            return {}
        return {
            "recorded": _time_of("recorded", _without_physics(np.concatenate(self._recorded))),
            "to_command_recorded": _time_of("to the command, recorded", np.concatenate(self._to_command_recorded)),
        }

    def _run_recorded(self) -> Array:
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
                return self._run(clocks_in_stages=False)
            finally:
                pipeline.listeners.remove(recorder)
                if fault := recorder.summary.pictures_fault:
                    raise PlantError(f"no pictures: {fault}")

    def _run(self, clocks_in_stages: bool) -> Array:
        pipeline, engaged = self._pipeline, round(_ENGAGED_AFTER * self._config.loop_rate_hz)
        pipeline.input = ScriptedInput(_TRAJECTORY, hands=tuple(pipeline.robot.arms))
        pipeline.stage_clock, pipeline.clocks_in_stages = StageClock(self._period), clocks_in_stages
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
