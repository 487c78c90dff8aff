"""Commands on recordings: ``q2r2 replay``, ``judge``, ``report`` and ``export``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer import Argument, Exit, Option

from q2r2_control.cli.cell_run import check_window, show_window
from q2r2_control.cli.output import (
    Anonymous,
    ClusterAddress,
    Json,
    Verbose,
    WebHost,
    WebPort,
    Workers,
    as_json_text,
    counted,
    counting,
    notice_of_compiling,
    say,
    verdict_markup,
)
from q2r2_control.cli.summary_figures import summary_table, verdict_line
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.recording import JudgeSettings
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import FASTEST, FrameSampling, Output, keep_episodes
from q2r2_control.export.formats import FORMATS, format_named
from q2r2_control.judging.judge import Judged, Judgement, Unreadable, discarded_episodes, judge_all, judgements_of
from q2r2_control.judging.page import COLUMNS, page_of
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.process.folders import check_file
from q2r2_control.process.places import chosen_place
from q2r2_control.recording.reader import Recording, recordings_in
from q2r2_control.recording.replay import replay as replay_recording
from q2r2_control.viewer.tables import figure_table, print_table
from q2r2_control.viewer.web.playback import Playback
from q2r2_control.viewer.web.view import PageView

# The columns that fit into a terminal. The page has all columns.
_SHOWN = ("success", "time", "idle", "gap", "delay", "error", "LDLJ")

_Judgement = TypeVar("_Judgement", bound=Judgement)

Recordings = Annotated[list[Path], Argument(metavar="DIR_OR_FILES...", help="Recordings, or folders with recordings.")]
Thresholds = Annotated[
    str | None, Option(metavar="CONFIG", help="Cell whose thresholds are used, instead of the recorded ones.")
]


def replay(
    file: Annotated[str, Argument(metavar="FILE", help="The .mcap file of q2r2 run --record, or its folder.")],
    compare: Annotated[
        bool, Option("--compare", help="Print the first difference and exit with 1, or print identical.")
    ] = False,
    config: Annotated[str | None, Option(metavar="CONFIG", help="Cell to use instead of the recorded one.")] = None,
    plant: Annotated[str | None, Option(metavar="NAME", help="Move and measure this plant.")] = None,
    viewer: Annotated[
        bool, Option("--viewer", help="With --plant mujoco: open its window and run in real time.")
    ] = False,
    web: Annotated[
        bool, Option("--web", help="Show the recording in a browser with a time line; needs the extra `web`.")
    ] = False,
    web_host: WebHost = "127.0.0.1",
    web_port: WebPort = 8080,
    verbose: Verbose = False,
    json: Json = False,
) -> None:
    """Give a recorded run's hand samples and measured states to the same loop again, tick by tick.

    With the same version and cell, all commands are equal to the bit. Lines on stderr name the differences between now
    and the time of the recording. With --plant, a plant moves, and its measured states replace the recorded ones.
    """
    if viewer:
        check_window(plant)

    cell = None if config is None else load_config(config)
    with ExitStack() as stack:
        page = stack.enter_context(PageView(web_host, web_port)) if web else None
        playback = None if page is None else Playback(page)

        def prepare(pipeline: Pipeline) -> None:
            if viewer:
                show_window(pipeline)
            if page is not None and playback is not None:
                playback.begin(pipeline, Path(file).stem)
                for line in page.lines:
                    say(line)

        with notice_of_compiling():
            result = replay_recording(Path(file), cell, plant, compare=compare, prepare=prepare, paced=viewer)
        if playback is not None:
            playback.wait()
    for note in result.notes:
        say(note, style="yellow")
    if result.ended_by is not None:
        say(f"ended after {result.ticks} ticks: {result.ended_by}")
    if json:
        data = {"ticks": result.ticks, "ended_by": result.ended_by, "notes": result.notes}
        difference = {"difference": result.difference} if compare else {}
        arms = {} if plant is None else {"plant": plant, "arms": result.arms}
        summary = None if result.summary is None else result.summary.as_json()
        print(as_json_text({**data, **difference, **arms, "summary": summary}))
    else:
        for name, arm in result.arms.items():
            off = f"{arm.position_mm_rms:.3f} mm RMS, {arm.position_mm_max:.3f} mm and {arm.rotation_deg_max:.3f} deg"
            print(f"{name} arm: tool {off} at most from where it was when recorded")
        if compare:
            print("identical" if result.difference is None else f"first difference at {result.difference}")
        elif result.summary is not None:
            console = Console()
            console.print(verdict_line(result.summary), soft_wrap=True, highlight=False)
            print_table(summary_table(result.summary, verbose), console)
    if compare and result.difference is not None:
        raise Exit(1)


def judge(
    recordings: Recordings,
    config: Thresholds = None,
    workers: Workers = 1,
    cluster: ClusterAddress = None,
    json: Json = False,
) -> None:
    """Say whether to keep or to discard each recorded episode, with reasons and numbers.

    The thresholds are those of the recorded cell, in its block `judge`. Exit code 2 if a file cannot be read.
    """
    place, settings, files = chosen_place(workers, cluster), _thresholds(config), recordings_in(recordings)
    found: list[Judgement | Unreadable] = []
    with counting("recordings") as progress:
        work = partial(judgements_of, settings)
        with closing(place.results(work, files, lambda file: file)) as results:
            for done, its in enumerate(results, start=1):
                found += its
                progress(f"recordings{place.where}", done, len(files))
    judged, unreadable = _split(found)
    if json:
        print(as_json_text({"episodes": [one.as_json() for one in found]}))
    else:
        _print_verdicts(judged, unreadable)
    if unreadable:
        raise Exit(2)


def _print_verdicts(judged: Sequence[Judgement], unreadable: Sequence[Unreadable]) -> None:
    console = Console()
    if judged:
        print_table(verdict_table(judged, unreadable), console)
    for one in judged:
        if not one.verdict.keep:
            name = one.figures.file + ("" if one.figures.part is None else f" #{one.figures.part}")
            console.print(f"{escape(name)}: {verdict_markup(one.verdict)}", soft_wrap=True, highlight=False)
    for bad in unreadable:
        console.print(f"{escape(str(bad.file))}: [red]{escape(bad.line)}[/]", soft_wrap=True, highlight=False)


def verdict_table(judged: Sequence[Judgement], unreadable: Sequence[Unreadable]) -> Table:
    """Return a table with a row for each episode. Figures that no episode has are left out, to make room for names."""
    # If a figure exists for several hands or arms, its column shows the worst number.
    shown = [column for column in COLUMNS if column.name in _SHOWN]
    columns = [column for column in shown if any(column.value(one.figures) is not None for one in judged)]
    kept = sum(one.verdict.keep for one in judged)
    rows = [(one.figures.name, one.verdict.word, *(column.text(one.figures) for column in columns)) for one in judged]
    rows += [(one.file.stem, "discard", *("-" for _ in columns)) for one in unreadable]
    title = f"episodes: {kept} kept, {len(rows) - kept} discarded"
    return figure_table(title, ("episode", "verdict", *(column.heading for column in columns)), rows)


def report(
    recordings: Recordings,
    output: Annotated[Path, Option(metavar="HTML", help="The page to write. An existing one is replaced.")],
    config: Thresholds = None,
) -> None:
    """Write one HTML page of recorded episodes: verdicts, numbers and plots. The page needs no network.

    Exit code 2 if a file cannot be read. The page names it.
    """
    check_file(output, "--output")
    settings, files, found = _thresholds(config), recordings_in(recordings), list[Judged | Unreadable]()
    with counting("recordings") as progress:
        for one in judge_all(files, settings):
            found.append(one)
            progress("", len(found), max(len(found), len(files)))
    judged, unreadable = _split(found)
    names = ", ".join(map(str, recordings))
    with counting("plots") as progress:
        page = page_of(judged, f"Recordings: {names}", lambda done: progress("", done, len(judged)), unreadable)
    try:
        output.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--output {output}: {error.strerror}; allowed: a file that you may write") from error
    kept, count = sum(one.verdict.keep for one in judged), len(found)
    print(f"{output}: {counted(count, 'episode')}, {kept} kept, {count - kept} discarded")
    for bad in unreadable:
        say(f"{bad.file}: {bad.line}", style="yellow")
    if unreadable:
        raise Exit(2)


def _cameras_with_depth(files: Iterable[Path]) -> tuple[str, ...]:
    """Return the cameras with depth in the first file that can be read.

    The other files have the same cameras, because all recordings of a dataset must have the same cameras.
    """
    for file in files:
        with suppress(RecordingError):
            return Recording(file).about.depth
    return ()


def _thresholds(config: str | None) -> JudgeSettings | None:
    """Return the thresholds of the cell ``config``; None if ``config`` is None.

    With None, each recording is judged by the thresholds of its own cell.
    """
    return None if config is None else load_config(config).judge


def _split(found: Sequence[_Judgement | Unreadable]) -> tuple[list[_Judgement], list[Unreadable]]:
    """Return two lists in the order of the files: the judgements, and the files that cannot be read."""
    bad = [one for one in found if isinstance(one, Unreadable)]
    return [one for one in found if not isinstance(one, Unreadable)], bad


def export(
    name: Annotated[
        str, Argument(metavar="FORMAT", help=f"{', '.join(FORMATS)}, or a format of an installed package.")
    ],
    recordings: Recordings,
    output: Annotated[Path, Option(metavar="OUT", help="Folder to write, which must not exist yet.")],
    fps: Annotated[int, Option(help=f"Frames per second: 1 .. {FASTEST}.")] = 30,
    trim: Annotated[bool, Option("--trim", help="Leave out the time before and after all motion.")] = False,
    workers: Workers = 1,
    cluster: ClusterAddress = None,
    keep_discarded: Annotated[
        bool, Option("--keep-discarded", help="Export also the episodes that q2r2 judge discards.")
    ] = False,
    skip_bad: Annotated[
        bool, Option("--skip-bad", help="End with exit code 0 even if recordings cannot be read.")
    ] = False,
    anonymous: Anonymous = False,
    no_pictures: Annotated[bool, Option("--no-pictures", help="Leave out the pictures of cameras.")] = False,
    ahead: Annotated[
        int | None,
        Option(
            metavar="FRAMES",
            help="Write the action of this many frames later into each row. The default depends on the format: "
            "1 for hdf5, 0 for lerobot and csv.",
        ),
    ] = None,
) -> None:
    """Make a training dataset from recordings of q2r2 run --record, with one episode for each recording.

    lerobot: a LeRobotDataset with a video of each camera; needs the extra `lerobot`. lerobot-v2.1: the same for openpi
    and Isaac GR00T; needs the extra `export`. hdf5: a file for each episode, for ACT and robomimic; needs the extra
    `export`. csv: tables of the same numbers. Episodes that q2r2 judge discards are left out and named. Exit code 2 if
    a recording cannot be read.
    """
    chosen = format_named(name)
    chosen.require()
    sampling = FrameSampling(
        fps, trim, pictures=not no_pictures, anonymous=anonymous, ahead=chosen.ahead if ahead is None else ahead
    )
    place = chosen_place(workers, cluster)
    target, files = Output(output), recordings_in(recordings)
    try:
        with counting("recordings") as progress:
            made = keep_episodes(
                files,
                sampling,
                chosen.write,
                target.episodes(),
                place=place,
                verdicts=None if keep_discarded else discarded_episodes,
                progress=lambda done: progress(f"recordings{place.where}", done, max(done, len(files))),
            )
    finally:
        target.tidy()
    for line in (*made.left_out, *made.unreadable):
        say(line, style="yellow")
    if not made.kept:
        discarded = "; --keep-discarded exports those that q2r2 judge discards" if made.left_out else ""
        raise RecordingError(f"none of the recordings can be exported{discarded}")
    target.write(lambda path: chosen.join(made.kept, path))
    whole = len(made.kept) + len(made.left_out) + len(made.unreadable) == len(files)
    count = f"{len(made.kept)} of" if whole else f"{counted(len(made.kept), 'episode')} of"
    print(f"{output}: {count} {counted(len(files), 'recording')} at {fps} frames per second")
    if sampling.pictures and not chosen.has_depth and (deep := _cameras_with_depth(files)):
        say(f"depth of {', '.join(deep)} is left out: {name} has no place for it; allowed: hdf5, zarr")
    if made.left_out:
        say(f"left out, since q2r2 judge discards them: {len(made.left_out)}; --keep-discarded exports them too")
    if chosen.advice is not None:
        print(chosen.advice(output))
    if made.unreadable and not skip_bad:
        raise Exit(2)
