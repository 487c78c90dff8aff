"""The recording of a run that the command line started, and the verdicts on its episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console

from q2r2_control.cli.output import print_lines, recording_line, say, verdict_markup
from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError, RecordingError
from q2r2_control.judging.episode_judge import EpisodeJudge
from q2r2_control.judging.judge import Judged, judge, keep_verdicts
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import PicturedPlant, is_mujoco
from q2r2_control.plugins import PLANTS, load_class
from q2r2_control.process.folders import check_folder
from q2r2_control.recording.about import About, anonymous
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import ROOM, ROOM_WITH_PICTURES, Recorder, RecordingSummary
from q2r2_control.teleop.both_arms import EpisodeMarks

if TYPE_CHECKING:
    from q2r2_control.cli.cell_run import RunOptions


class RunRecording(AbstractContextManager["RunRecording"]):
    """The recording of one run. Its writer runs while this context manager is open."""

    def __init__(self, folder: Path, options: RunOptions, config: Config, devices: Sequence[str]) -> None:
        """Make the recorder. ``devices`` are the names of the open real cameras.

        Raises:
            ConfigError: If recordings cannot be written into ``folder``.
        """
        check_folder(folder, "--record")
        pictures = bool(config.simulated_cameras) and issubclass(load_class(PLANTS, options.plant), PicturedPlant)
        room = ROOM_WITH_PICTURES if devices else ROOM
        self._options, self._devices = options, tuple(devices)
        self.recorder = Recorder(folder, options.name, waits=options.simulated_time, room=room, pictures=pictures)

    def __enter__(self) -> RunRecording:
        self.recorder.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the recording. If a fault of the plant ended the run, print what was recorded."""
        self.recorder.__exit__(kind, error, trace)
        if isinstance(error, PlantError):
            print_lines(Console(stderr=True), recording_lines(self.recorder.summary))

    def begin(self, pipeline: Pipeline, stack: ExitStack, console: Console) -> tuple[Recorder, About]:
        """Record ``pipeline`` from its first tick on. Return the recorder, and the facts about the recording.

        Each episode is judged when it ends, until ``stack`` is closed.
        """
        recorder, options = self.recorder, self._options
        cameras = tuple(pipeline.config.simulated_cameras)
        if cameras and is_mujoco(pipeline.plant):
            recorder.prepare(pipeline.plant, pipeline.robot, pipeline.config.simulated_cameras)
        elif cameras:
            none = f"no pictures are recorded: the {options.plant} plant has none; allowed: --plant mujoco"
            say(none, console, "yellow")
            cameras = ()
        cameras += self._devices
        recorder.record_outcome = pipeline.record_outcome
        notes = {"cell": pipeline.config.name, "input": options.input, **options.notes}
        given = options.input_options.items()
        # The option fast is left out, because it does not change the motion.
        notes |= {name: str(value) for name, value in given if name != "fast"}
        about = About.of(pipeline, not options.simulated_time, notes, cameras)
        if options.anonymous:
            about = replace(about, notes=anonymous(about.notes))
        recorder.begin(about, pipeline.robot, pipeline.config.recording.topic_rate)
        pipeline.listeners.append(recorder)
        if any(map(pipeline.config.teleop.bindings.words_of, EpisodeMarks.actions)):
            judge_now = EpisodeJudge(lambda: recorder.file, pipeline.record_outcome)
            pipeline.listeners.append(stack.enter_context(judge_now))
        return recorder, about


def judge_recording(recording: RecordingSummary | None) -> list[Judged]:
    """Judge the recording's file, and write the verdicts into a file beside it. A failure is one line on stderr."""
    if recording is None or recording.file is None or not Path(recording.file).exists():
        return []
    try:
        judged = judge(Recording(Path(recording.file)))
        keep_verdicts(judged)
    except RecordingError as error:
        say(f"not judged: {error}")
        return []
    return judged


def recording_lines(recording: RecordingSummary) -> Iterator[str]:
    """Yield lines of markup with the file of the recording and the verdicts on its episodes."""
    yield recording_line(recording)
    for one in judge_recording(recording):
        which = "" if one.figures.part is None else f" on episode {one.figures.part}"
        yield f"verdict{which}: {verdict_markup(one.verdict)}"
