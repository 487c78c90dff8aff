"""A run as the command line offers it: pipeline, live table, window, recording."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from q2r2_control.cli.headset_check import AnnouncedHeadset
from q2r2_control.cli.output import as_json_text, notice_of_compiling, say
from q2r2_control.cli.summary_table import recording_line, summary_table, task_line, verdict_markup
from q2r2_control.config.cell import Config
from q2r2_control.config.external import ControllerKind
from q2r2_control.demo.assembly_tasks import AssemblyTask, TaskResult, TaskWatch
from q2r2_control.errors import ConfigError, PlantError, RecordingError
from q2r2_control.inputs.base import Input, make_input
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.judging.episode_judge import EpisodeJudge
from q2r2_control.judging.judge import Judged, judge, keep_verdicts
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.scheduling import real_time
from q2r2_control.recording.about import About
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import Recorder, RecordingSummary
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.supervision.homing import preflight_faults
from q2r2_control.teleop.both_arms import EpisodeMarks
from q2r2_control.viewer.live import LiveTable

_PERIOD = 1.0 / 30.0  # [s]


def check_window(plant: str | None) -> None:
    """Raises :class:`ConfigError` for a plant without a window."""
    if plant != "mujoco":
        which = "without --plant there is no window" if plant is None else f"the {plant} plant has no window"
        raise ConfigError(f"--viewer: {which}; allowed: --plant mujoco")


def show_window(pipeline: Pipeline, *, paced: bool = False) -> None:
    """Open the window and keep it up to date while ``pipeline`` runs, which closing it ends.

    ``paced``: simulated time passes no faster than that of the clock on the wall. Raises :class:`PlantError` where
    there is no display.
    """
    if isinstance(pipeline.plant, MujocoPlant):
        pipeline.plant.launch_viewer()
        pipeline.listeners.append(_WindowListener(pipeline, pipeline.plant, paced))


class _WindowListener:
    """Shows the window some thirty times a second."""

    def __init__(self, pipeline: Pipeline, plant: MujocoPlant, paced: bool) -> None:
        self._pipeline, self._plant, self._paced = pipeline, plant, paced
        self._due = 0.0
        self._began: float | None = None

    def __call__(self, tick: Tick) -> None:
        if tick.t < self._due:
            return
        self._due = tick.t + _PERIOD
        if self._paced:
            now = time.monotonic()
            self._began = now - tick.t if self._began is None else self._began
            time.sleep(max(self._began + tick.t - now, 0.0))
        if not self._plant.viewer_sync():
            self._pipeline.stop()


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Choices of the command line."""

    name: str  # of the run, for its recording's folder and title
    input: str
    plant: str
    mode: str
    duration: float | None  # [s]; None: until Ctrl-C
    fast: bool  # simulated time
    trajectory: str  # of the scripted input
    human: bool
    seed: int
    table: bool
    window: bool
    force: bool  # run although q2r2 check finds faults
    real_time: bool  # ask the system for locked memory and SCHED_FIFO
    tasks: tuple[AssemblyTask, ...] = ()  # to be judged
    record: Path | None = None  # folder of recordings
    notes: Mapping[str, str] = field(default_factory=dict)  # by name, for the recording


@dataclass(frozen=True, slots=True)
class CellRun:
    """Results of a run."""

    summary: RunSummary
    tasks: tuple[TaskResult, ...] = ()
    recording: RecordingSummary | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary, and where there were tasks or a recording what became of them."""
        data = self.summary.as_json()
        if self.tasks:
            data["tasks"] = [asdict(task) for task in self.tasks]
        if self.recording is not None:
            data["recording"] = asdict(self.recording)
        return data


def run_cell(config: Config, options: RunOptions, console: Console) -> CellRun:
    """Run a cell and tell ``console`` about it. Raises :class:`Q2R2Error` where that is not possible as asked."""
    if config.controller is ControllerKind.EXTERNAL:
        builtin = "this command runs controller: builtin only"
        raise ConfigError(f"{config.name}: controller: external is driven by q2r2 ros up; {builtin}")
    if options.window:
        check_window(options.plant)
    if options.record is None:
        return _run_cell(config, options, None, console)
    # Before the pipeline, which takes longer to build than the recorder's process to start.
    pictures = bool(config.simulated_cameras) and options.plant == "mujoco"
    recorder = Recorder(options.record, options.name, waits=options.fast, pictures=pictures)
    try:
        return _run_cell(config, options, recorder, console)
    except PlantError:
        for line in _recording_lines(recorder.summary):
            console.print(line, soft_wrap=True, highlight=False)
        raise


def _run_cell(config: Config, options: RunOptions, recorder: Recorder | None, console: Console) -> CellRun:
    with recorder or nullcontext():
        with notice_of_compiling(console):
            source = _input_of(config, options, console)
            pipeline = Pipeline.from_config(config, input=source, plant=options.plant, mode=options.mode)
            _refuse_faults(pipeline, options.force, console)
        watch = None
        if options.tasks and isinstance(pipeline.plant, MujocoPlant):
            watch = TaskWatch(options.tasks, pipeline.plant, pipeline.robot, config)
            pipeline.listeners.append(watch)
        summary = _run(pipeline, options, recorder, console)
        if recorder is not None and watch is not None:
            recorder.success = all(task.succeeded for task in watch.results())
    results = () if watch is None else watch.results()
    return CellRun(summary, results, None if recorder is None else recorder.summary)


def print_summary(run: CellRun, json: bool) -> None:
    """Print the summary of a run on stdout, as a table or as one JSON object, and the verdict on its recording."""
    if json:
        judged = _judge_recording(run.recording)
        verdict = {"judge": [one.as_json() for one in judged]} if judged else {}
        print(as_json_text({**run.as_json(), **verdict}))
        return
    console = Console()
    console.print(summary_table(run.summary))
    for task in run.tasks:
        console.print(task_line(task), soft_wrap=True, highlight=False)
    if run.recording is not None:
        for line in _recording_lines(run.recording):
            console.print(line, soft_wrap=True, highlight=False)


def _recording_lines(recording: RecordingSummary) -> Iterator[str]:
    """Lines of markup: where the run was recorded, and the verdicts on its episodes."""
    yield recording_line(recording)
    for one in _judge_recording(recording):
        which = "" if one.figures.part is None else f" on episode {one.figures.part}"
        yield f"verdict{which}: {verdict_markup(one.verdict)}"


def _judge_recording(recording: RecordingSummary | None) -> list[Judged]:
    """Judge the file as it was written, and keep the verdicts beside it. Whatever fails is one line on stderr."""
    if recording is None or recording.file is None or not Path(recording.file).exists():
        return []
    try:
        judged = judge(Recording(Path(recording.file)))
        keep_verdicts(judged)
    except RecordingError as error:
        say(f"not judged: {error}")
        return []
    return judged


def _refuse_faults(pipeline: Pipeline, force: bool, console: Console) -> None:
    """Raises :class:`ConfigError` for a cell in which ``q2r2 check`` finds a fault; with ``force`` only prints them."""
    config = pipeline.config
    faults = preflight_faults(pipeline.robot, config.control.without_contact(), pipeline.controller)
    if not faults:
        return
    if not force:
        raise ConfigError(f"{config.name}: {'; '.join(faults)}; --force runs it all the same")
    for fault in faults:
        say(f"FAULT {fault}", console, "red")


def _input_of(config: Config, options: RunOptions, console: Console) -> Input:
    if options.input == "headset":
        return AnnouncedHeadset(config, console)
    if options.input == "scripted":
        return ScriptedInput(options.trajectory, human=options.human, seed=options.seed)
    return make_input(options.input, config)


def _run(pipeline: Pipeline, options: RunOptions, recorder: Recorder | None, console: Console) -> RunSummary:
    """Run with what is to be shown and recorded of it."""
    with ExitStack() as stack:
        if options.window:
            show_window(pipeline)
        if options.table:
            robot = pipeline.robot
            joints = {arm: [robot.joint_names[joint] for joint in its.joints] for arm, its in robot.arms.items()}
            title = f"{options.name}: Ctrl-C brings the arms to rest and ends"
            table = LiveTable(title, joints, pipeline.config.teleop.bindings)
            pipeline.listeners.append(table)
            stack.enter_context(table.shown(console))
        if options.real_time and (refused := stack.enter_context(real_time())):
            say(refused, console, "yellow")
        if recorder is not None:
            cameras = pipeline.config.simulated_cameras
            if cameras and isinstance(pipeline.plant, MujocoPlant):
                recorder.prepare(pipeline.plant, pipeline.robot, cameras)
            elif cameras:
                none = f"no pictures are recorded: the {options.plant} plant has none; allowed: --plant mujoco"
                say(none, console, "yellow")
            recorder.record_outcome = pipeline.record_outcome
            recorder.begin(_about(pipeline, options), pipeline.robot)
            pipeline.listeners.append(recorder)
            if any(map(pipeline.config.teleop.bindings.words_of, EpisodeMarks.actions)):
                judge_now = EpisodeJudge(lambda: recorder.file, pipeline.record_outcome)
                pipeline.listeners.append(stack.enter_context(judge_now))
        return pipeline.run(options.duration, realtime=not options.fast)


def _about(pipeline: Pipeline, options: RunOptions) -> About:
    """Facts that a recording states once, of a run that begins now."""
    notes = {"cell": pipeline.config.name, "input": options.input, **options.notes}
    if options.input == "scripted":
        notes |= {"trajectory": options.trajectory, "human": str(options.human).lower(), "seed": str(options.seed)}
    cameras = tuple(pipeline.config.simulated_cameras) if isinstance(pipeline.plant, MujocoPlant) else ()
    return About.of(pipeline, not options.fast, notes, cameras)
