"""``q2r2 export``: recordings as datasets to train on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from q2r2_control.cli.output import stderr_console
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.csv_tables import gather_tables, move_table, write_table
from q2r2_control.export.episodes import FASTEST, FrameSampling
from q2r2_control.export.hdf5 import gather_files, require_h5py, write_file
from q2r2_control.export.kept_episodes import Output, Write, keep_episodes
from q2r2_control.export.lerobot import join_shards, require_lerobot, write_shard
from q2r2_control.recording.reader import recordings_in

app = typer.Typer(rich_markup_mode=None, help="Recordings of q2r2 run --record as datasets to train on.")

Recordings = Annotated[
    list[Path], typer.Argument(metavar="DIR_OR_FILES...", help="Recordings, or folders of them, in this order.")
]
Fps = Annotated[int, typer.Option(help=f"Frames per second: 1 .. {FASTEST}.")]
Trim = Annotated[bool, typer.Option("--trim", help="Leave out what is before and after any arm is engaged or moving.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes; the result is the same for any number.")]
NoPictures = Annotated[bool, typer.Option("--no-pictures", help="Leave out what cameras recorded.")]
SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Say which recordings are bad, and go on without them.")]


@app.command(epilog="Example: q2r2 export lerobot recordings --output datasets/circle --fps 30")
def lerobot(
    recordings: Recordings,
    output: Annotated[Path, typer.Option(metavar="OUT", help="A folder that does not exist yet.")],
    fps: Fps = 30,
    trim: Trim = False,
    workers: Workers = 1,
    skip_bad: SkipBad = False,
    no_pictures: NoPictures = False,
) -> None:
    """Make a LeRobotDataset of recordings: an episode each, with a video of each camera. Needs the extra `lerobot`."""
    require_lerobot()
    sampling = FrameSampling(fps, trim, pictures=not no_pictures)
    _export(recordings, sampling, output, workers, skip_bad, write_shard, join_shards)


@app.command(epilog="Example: q2r2 export hdf5 recordings --output datasets/circle-act --fps 50")
def hdf5(
    recordings: Recordings,
    output: Annotated[Path, typer.Option(metavar="OUT", help="A folder that does not exist yet.")],
    fps: Fps = 30,
    trim: Trim = False,
    workers: Workers = 1,
    skip_bad: SkipBad = False,
    no_pictures: NoPictures = False,
) -> None:
    """Make HDF5 files of recordings, a file each, for trainers of ACT. Needs the extra `export`."""
    require_h5py()
    sampling = FrameSampling(fps, trim, pictures=not no_pictures)
    _export(recordings, sampling, output, workers, skip_bad, write_file, gather_files)


@app.command(epilog="Example: q2r2 export csv recordings/20260101-120000-dual_iiwa7 --output circle.csv")
def csv(
    recordings: Recordings,
    output: Annotated[
        Path, typer.Option(metavar="OUT", help="A file .csv for one recording; else a folder, a file in it for each.")
    ],
    fps: Fps = 30,
    trim: Trim = False,
    workers: Workers = 1,
    skip_bad: SkipBad = False,
) -> None:
    """Make tables of recordings: a line a frame, the numbers of the dataset of q2r2 export lerobot."""
    one_file = output.suffix == ".csv"
    if one_file and (count := len(recordings_in(recordings))) > 1:
        raise ConfigError(f"--output {output}: for {count} recordings; allowed: a folder, or one recording")
    join = move_table if one_file else gather_tables
    _export(recordings, FrameSampling(fps, trim), output, workers, skip_bad, write_table, join)


def _export(
    recordings: Sequence[Path],
    sampling: FrameSampling,
    path: Path,
    workers: int,
    skip_bad: bool,
    write: Write,
    join: Callable[[Sequence[Path], Path], None],
) -> None:
    """``write`` keeps each episode, and ``join`` makes the output of what was kept."""
    console = stderr_console()
    output = Output(path)
    files = recordings_in(recordings)
    try:
        with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
            bar = progress.add_task("recordings", total=len(files))
            made = keep_episodes(
                files,
                sampling,
                write,
                output.episodes(),
                workers=workers,
                skip_bad=skip_bad,
                progress=lambda done: progress.update(bar, completed=done, total=max(done, len(files))),
            )
    finally:
        output.tidy()
    for fault in made.skipped:
        console.print(f"skipped: {fault}", style="yellow", soft_wrap=True, highlight=False, markup=False)
    if not made.kept:
        raise RecordingError("none of the recordings can be exported")
    output.write(lambda target: join(made.kept, target))
    whole = len(made.kept) + len(made.skipped) == len(files)
    count = f"{len(made.kept)} of" if whole else f"{len(made.kept)} episodes of"
    print(f"{path}: {count} {len(files)} recordings at {sampling.fps} frames per second")
