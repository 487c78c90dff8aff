"""``q2r2 export``: recordings as datasets to train on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from q2r2_control.cli.output import counting, stderr_console
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import FASTEST, FrameSampling, Output, keep_episodes
from q2r2_control.export.formats import FORMATS
from q2r2_control.recording.reader import recordings_in

_FORMATS = ", ".join(FORMATS)


def export(
    name: Annotated[str, typer.Argument(metavar="FORMAT", help=f"One of {_FORMATS}.")],
    recordings: Annotated[
        list[Path], typer.Argument(metavar="DIR_OR_FILES...", help="Recordings, or folders of them, in this order.")
    ],
    output: Annotated[Path, typer.Option(metavar="OUT", help="A folder that does not exist yet.")],
    fps: Annotated[int, typer.Option(help=f"Frames per second: 1 .. {FASTEST}.")] = 30,
    trim: Annotated[
        bool, typer.Option("--trim", help="Leave out what is before and after any arm is engaged or moving.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes; the result is the same for any number.")] = 1,
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Say which recordings are bad, and go on without them.")
    ] = False,
    no_pictures: Annotated[bool, typer.Option("--no-pictures", help="Leave out what cameras recorded.")] = False,
) -> None:
    """Make a dataset of recordings, an episode each.

    lerobot: a LeRobotDataset, with a video of each camera; needs the extra `lerobot`. hdf5: a file for each episode,
    for trainers of ACT; needs the extra `export`. csv: a table for each episode, without pictures.
    """
    if (chosen := FORMATS.get(name)) is None:
        raise ConfigError(f"export {name}: allowed: {_FORMATS}")
    chosen.require()
    sampling = FrameSampling(fps, trim, pictures=not no_pictures)
    made_output = Output(output)
    files = recordings_in(recordings)
    try:
        with counting("recordings") as progress:
            made = keep_episodes(
                files,
                sampling,
                chosen.write,
                made_output.episodes(),
                workers=workers,
                skip_bad=skip_bad,
                progress=lambda done: progress("", done, max(done, len(files))),
            )
    finally:
        made_output.tidy()
    for fault in made.skipped:
        stderr_console().print(f"skipped: {fault}", style="yellow", soft_wrap=True, highlight=False, markup=False)
    if not made.kept:
        raise RecordingError("none of the recordings can be exported")
    made_output.write(lambda target: chosen.join(made.kept, target))
    whole = len(made.kept) + len(made.skipped) == len(files)
    count = f"{len(made.kept)} of" if whole else f"{len(made.kept)} episodes of"
    print(f"{output}: {count} {len(files)} recordings at {sampling.fps} frames per second")
