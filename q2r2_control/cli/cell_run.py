"""Run a cell from the command line, with pipeline, live table, window and recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from q2r2_control.cli.output import (
    SCRIPTS_WAIT_S,
    ProgressLines,
    as_json_text,
    late_line,
    notice_of_compiling,
    print_lines,
    say,
    task_line,
)
from q2r2_control.cli.summary_figures import summary_table, verdict_line
from q2r2_control.config.cell import Config
from q2r2_control.config.external import ControllerKind
from q2r2_control.demo.assembly_tasks import AssemblyTask, TaskResult, TaskWatch, held_to_promises, note_on_parts
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.extras import require
from q2r2_control.inputs.base import PolicySource, is_simulated, make_input
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import Plant, WaitingPlant, WindowedPlant, is_mujoco, make_plant
from q2r2_control.plugins import INPUTS, PLANTS, load_class
from q2r2_control.process.scheduling import real_time
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.viewer.episode_words import EpisodeWords
from q2r2_control.viewer.live import LiveTable
from q2r2_control.viewer.live_pictures import LivePictures, ShownPictures
from q2r2_control.viewer.shown_robot import ShownRobot
from q2r2_control.viewer.state_colours import obstacle_colour
from q2r2_control.viewer.tables import print_table

if TYPE_CHECKING:
    from q2r2_control.cameras.camera_streams import CameraStreams
    from q2r2_control.cli.run_recording import RunRecording
    from q2r2_control.recording.recorder import RecordingSummary
    from q2r2_control.viewer.web.view import PageView

_SHOWS_PICTURES = "show_picture"  # An input has this method if its device can show the run, as a headset can.
_PERIOD = 1.0 / 30.0  # Period at which the window is drawn [s].
# Largest number of pictures per second. On a page, it counts the pictures of all cameras together. A headset shows only
# one camera.
_ON_PAGE, _IN_HEADSET = 5.0, 30.0


def check_window(plant: str | None) -> None:
    """Raise :class:`ConfigError` for a plant without a window."""
    if plant is None or not issubclass(load_class(PLANTS, plant), WindowedPlant):
        which = "without --plant there is no window" if plant is None else f"the {plant} plant has no window"
        raise ConfigError(f"--viewer: {which}; allowed: a plant that has one, as --plant mujoco")


def show_window(pipeline: Pipeline) -> None:
    """Open the window and keep it up to date while ``pipeline`` runs. Closing the window ends the run.

    Raises:
        PlantError: If there is no display.
    """
    plant, due = pipeline.plant, 0.0
    if not isinstance(plant, WindowedPlant):
        return
    plant.launch_viewer()
    if is_mujoco(plant):
        plant.viewer_say("")

    def show(tick: Tick) -> None:
        nonlocal due
        if tick.t < due:
            return
        due = tick.t + _PERIOD
        if not plant.viewer_sync([(one.obstacle, obstacle_colour(one)) for one in tick.obstacles.values()]):
            pipeline.stop()

    pipeline.listeners.append(show)


_EARLY = 0.1  # If a run ends earlier than its planned end by more than this, somebody stopped it [s].


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The choices of the user on the command line."""

    name: str  # Name of the run. It is used in titles and in the name of the recording's folder.
    input: str
    plant: str
    mode: str
    duration: float | None  # Duration of the run [s]; None for a run until Ctrl-C.
    fast: bool  # Whether simulated time runs as fast as possible. Otherwise it is not faster than real time.
    input_options: Mapping[str, object]  # The options of the input, by name.
    table: bool  # Whether a live table is shown.
    window: bool  # Whether the plant's window is opened.
    real_time: bool  # Whether to request locked memory and SCHED_FIFO from the system.
    force: bool = False  # Whether to run although q2r2 check finds faults.
    tasks: tuple[AssemblyTask, ...] = ()  # Tasks to be judged.
    steps: tuple[tuple[float, str], ...] = ()  # Steps of scripted work, each with its start [s] and its name.
    record: Path | None = None  # Folder of recordings; None for no recording.
    notes: Mapping[str, str] = field(default_factory=dict)  # Notes for the recording, by name.
    anonymous: bool = False  # Whether the recording leaves out the operator and the computer's name.
    longest_wait: float = SCRIPTS_WAIT_S  # Longest time for which a plant waits for a person at a cabinet [s].
    # For a page in the browser: its host, its port, and the path of its certificate or None. None for no page.
    page: tuple[str, int, Path | None] | None = None

    @property
    def simulated_time(self) -> bool:
        """True if the run can be in simulated time, because it needs neither a person's hands nor a real plant."""
        inputs = filter(None, (self.input, self.input_options.get("takeover")))
        is_simulated_plant = bool(getattr(load_class(PLANTS, self.plant), "simulated", False))
        return self.fast or (is_simulated_plant and all(is_simulated(str(name)) for name in inputs))


@dataclass(frozen=True, slots=True)
class CellRun:
    """The results of a run."""

    summary: RunSummary
    tasks: tuple[TaskResult, ...] = ()
    recording: RecordingSummary | None = None
    planned: float | None = None  # Planned duration of the run [s]; None for a run until Ctrl-C.

    @property
    def cut_short(self) -> bool:
        """Whether somebody ended the run before its planned end, so that a task may be unfinished."""
        return self.planned is not None and self.summary.duration_s < self.planned - _EARLY

    @property
    def was_recorded(self) -> bool:
        """False if the recording ended before the run did."""
        return self.recording is None or self.recording.fault is None


def run_cell(config: Config, options: RunOptions) -> CellRun:
    """Run a cell, and print lines about the run on stderr. Raises :class:`Q2R2Error` if the run is not possible."""
    if config.controller is ControllerKind.EXTERNAL:
        builtin = "this command runs controller: builtin only"
        raise ConfigError(f"{config.name}: controller: external is driven by q2r2 ros up; {builtin}")
    if options.window:
        check_window(options.plant)
    # The processes of the cameras start first, so that they start up while the pipeline is built, which takes longer.
    with _opened_devices(config, options) as streams:
        if options.page is None:
            return _run_recorded(config, options, None, streams)
        require("web", "--web")
        # The import is here, because a run without a page does not need this module.
        from q2r2_control.viewer.web.view import PageView

        with PageView(*options.page) as page:
            return _run_recorded(config, options, page, streams)


def _opened_devices(config: Config, options: RunOptions) -> AbstractContextManager[CameraStreams | None]:
    """Open all real cameras if pictures are recorded, shown or given to the input; otherwise the context gives None."""
    source = load_class(INPUTS, options.input)
    sees = any(hasattr(source, method) for method in (_SHOWS_PICTURES, PolicySource.observe.__name__))
    used = not options.fast and (options.record is not None or options.page is not None or sees)
    if not (used and config.device_cameras):
        return nullcontext()
    # The import is here, because other runs do not need this module.
    from q2r2_control.cameras.camera_streams import CameraStreams

    return CameraStreams(config.device_cameras)


def _run_recorded(config: Config, options: RunOptions, page: PageView | None, streams: CameraStreams | None) -> CellRun:
    if options.record is None:
        return _run_cell(config, options, None, page, streams)
    require("data", "--record")
    # The import is here, because a run without --record does not need this module.
    from q2r2_control.cli.run_recording import RunRecording

    devices = () if streams is None else tuple(streams.streams)
    with RunRecording(options.record, options, config, devices) as recording:
        run = _run_cell(config, options, recording, page, streams)
    return replace(run, recording=recording.recorder.summary)


def _run_cell(
    config: Config,
    options: RunOptions,
    recording: RunRecording | None,
    page: PageView | None,
    streams: CameraStreams | None,
) -> CellRun:
    console = Console(stderr=True)
    source = make_input(options.input, config, say=partial(say, console=console), **options.input_options)
    robot = Robot.from_config(config)
    try:
        plant = make_plant(options.plant, robot, config)
    except PlantError as error:
        if options.plant != "mujoco":  # q2r2 check reports the error below, but only for MuJoCo.
            raise
        raise PlantError(f"{config.name}: FAULT plant {options.plant}: {error}") from error
    if isinstance(plant, WaitingPlant):
        plant.longest_wait = plant.longest_session_wait = options.longest_wait
    try:
        if options.window:
            _open_window(plant)
        with notice_of_compiling():
            pipeline = Pipeline(config, robot, source, plant, options.mode)
            faults = pipeline.preflight_faults()
        return _run_pipeline(pipeline, faults, options, recording, page, streams, console)
    finally:
        # The plant is closed even if no run began, because an open window would crash the ending process.
        plant.close()


def _open_window(plant: Plant) -> None:
    """Show the arms at home while the controller is built, which takes minutes if its kernels have to be compiled."""
    if is_mujoco(plant):
        plant.launch_viewer()
        plant.viewer_say("preparing the controller")
        plant.viewer_sync()


def _run_pipeline(
    pipeline: Pipeline,
    faults: tuple[str, ...],
    options: RunOptions,
    recording: RunRecording | None,
    page: PageView | None,
    streams: CameraStreams | None,
    console: Console,
) -> CellRun:
    config, source = pipeline.config, pipeline.input
    if faults and not options.force:
        allowed = "--force runs it all the same"
        lines = [f"{config.name}: FAULT {fault}" for fault in faults]
        raise ConfigError(f"{config.name}: {'; '.join(faults)}; {allowed}", [*lines, f"{config.name}: {allowed}"])
    for fault in faults:
        say(f"FAULT {fault}", console, "red")
    if config.note_on_grippers is not None:
        say(config.note_on_grippers, console, "yellow")
    if (note := note_on_parts(str(options.input_options.get("trajectory", "")), config)) is not None:
        say(note, console, "yellow")
    watch = None
    if options.tasks and is_mujoco(pipeline.plant):
        watch = TaskWatch(options.tasks, pipeline.plant, pipeline.robot, config)
        pipeline.listeners.append(watch)
    display: Any = source
    if hasattr(display, _SHOWS_PICTURES):
        from q2r2_control.viewer.headset_view import HeadsetView

        HeadsetView(display, pipeline, recording is not None)
    if page is not None:
        page.begin(pipeline, options.name, recording is not None)
        for line in page.lines:
            say(line, console)
    summary = _run(pipeline, options, recording, page, streams, console)
    results = () if watch is None else held_to_promises(watch.results(), summary)
    run = CellRun(summary, results, planned=options.duration)
    succeeded = all(task.succeeded for task in results)
    if recording is not None and results and (succeeded or not run.cut_short):
        recording.recorder.success = succeeded
    return run


def print_summary(run: CellRun, json: bool, verbose: bool = False) -> None:
    """Print on stdout the verdicts on a run, its tasks and its recording, and the summary.

    With ``json``, print all of them as one JSON object.
    """
    if json:
        data = run.summary.as_json()
        if run.tasks:
            data["tasks"] = run.tasks
        if run.recording is not None:
            from q2r2_control.cli.run_recording import judge_recording

            data["recording"] = run.recording
            if judged := judge_recording(run.recording):
                data["judge"] = [one.as_json() for one in judged]
        print(as_json_text(data))
        return
    console = Console()
    tasks = [task for task in run.tasks if task.succeeded or not run.cut_short]
    failed = [f"task {task.name} failed" for task in tasks if not task.succeeded]
    failed += [] if run.was_recorded else ["the recording ended before the run"]
    stopped = None
    if open_tasks := [task.name for task in run.tasks if task not in tasks]:
        after = f"stopped after {run.summary.duration_s:.1f} of {run.planned:.1f} s"
        stopped = f"[yellow]{after}[/]: not judged: {', '.join(open_tasks)}"
    print_lines(console, [verdict_line(run.summary, failed, stopped), *map(task_line, tasks)])
    if (late := late_line(run.summary, run.tasks)) is not None:
        print_lines(console, [late])
    if run.recording is not None:
        from q2r2_control.cli.run_recording import recording_lines

        print_lines(console, recording_lines(run.recording))
    print_table(summary_table(run.summary, verbose), console)


def _run(
    pipeline: Pipeline,
    options: RunOptions,
    recording: RunRecording | None,
    page: PageView | None,
    streams: CameraStreams | None,
    console: Console,
) -> RunSummary:
    """Run the pipeline with its table, window, pictures and recording."""
    with ExitStack() as stack:
        if options.window:
            show_window(pipeline)
        if options.table:
            title = f"{options.name}: Ctrl-C brings the arms to rest and ends"
            shown, simulated = ShownRobot.of(pipeline.robot, pipeline.config), options.simulated_time
            words = shown.words(pipeline.input.controls.words)
            episodes = EpisodeWords(pipeline.config.recording.subtasks) if recording is not None else None
            table = LiveTable(
                title, words, options.steps, options.duration, simulated_time=simulated, episodes=episodes
            )
            pipeline.listeners.append(table)
            stack.enter_context(table.shown(console))
        else:
            # Without this line, nothing would be printed during the run, which may take minutes on a slow computer.
            kind = "simulated time" if options.simulated_time else "real time"
            lasts = "until Ctrl-C" if options.duration is None else f"{options.duration:g} s"
            is_shown = options.window or page is not None or options.input == "webxr"
            unseen = "" if is_shown or options.fast else "; --web shows the arms in a browser"
            say(f"{options.name}: begins, {lasts}, in {kind}{unseen}", console)
            if options.duration is not None:
                pipeline.listeners.append(ProgressLines(options.name, options.duration, console))
        if streams is not None:
            streams.wait_until_ready()
        pipeline.cameras = streams
        devices = {} if streams is None else streams.streams
        drawn = pipeline.config.simulated_cameras if is_mujoco(pipeline.plant) else {}
        for name, most, show, watched in _lookers(pipeline, page, [*drawn, *devices]):
            if name in devices:
                devices[name].hear(ShownPictures(most, show, watched))
            elif is_mujoco(pipeline.plant):
                pictures = LivePictures(pipeline.plant, name, drawn[name], most, show, watched)
                pipeline.listeners.append(stack.enter_context(pictures))
        if options.real_time and (refused := stack.enter_context(real_time())):
            say(refused, console, "yellow")
        observes = recording is not None or isinstance(pipeline.input, PolicySource)
        if options.fast and observes and (real := ", ".join(pipeline.config.device_cameras)):
            say(f"no pictures of {real}: real cameras keep real time; allowed: without --fast", console, "yellow")
        recorded = None if recording is None else recording.begin(pipeline, stack, console)
        if streams is not None:
            from q2r2_control.recording.device_pictures import DevicePictures

            seen = DevicePictures(streams, not options.simulated_time, pipeline.record_outcome, recorded)
            pipeline.listeners.append(stack.enter_context(seen))
        return pipeline.run(options.duration, realtime=not options.simulated_time, paced=not options.fast)


def _lookers(
    pipeline: Pipeline, page: PageView | None, names: Sequence[str]
) -> Iterator[tuple[str, float, Callable[[bytes], object], Callable[[], bool]]]:
    """Yield four items for each camera that a headset or a page shows.

    The items are: the camera's name; the largest number of pictures per second; a function that shows a picture; and a
    function that returns whether somebody looks. ``names`` are the names of all cameras with pictures. A headset shows
    only the first camera.
    """
    source: Any = pipeline.input
    if hasattr(source, _SHOWS_PICTURES):
        yield from ((name, _IN_HEADSET, source.show_picture, lambda: source.connected) for name in names[:1])
    if page is not None:
        yield from (
            (name, _ON_PAGE / len(names), partial(page.show_picture, name), lambda: page.watched) for name in names
        )
