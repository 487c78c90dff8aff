"""A format of ``q2r2 export``. Other packages declare theirs as entry points of ``q2r2_control.exports``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.export.episodes import EpisodeVectors


@dataclass(frozen=True)
class ExportFormat:
    """The functions that write episodes one by one, and then join them in the output.

    ``write(episode, path)`` makes a file or a folder of one :class:`EpisodeVectors`. It is a function of a module,
    since other processes call it. A part of an earlier attempt may exist at ``path``. ``join(paths, folder)`` makes the
    new ``folder`` from these paths, in their order, and may move them. Both raise :class:`RecordingError`, with the
    name of the recording, for episodes that the format cannot store.
    """

    write: Callable[[EpisodeVectors, Path], None]
    join: Callable[[Sequence[Path], Path], None]
    require: Callable[[], object] = lambda: None  # Raises ConfigError if a package is not installed.
    advice: Callable[[Path], str] | None = None  # Returns a text that tells how to train on the output.
    has_depth: bool = False  # Whether it stores the depth of cameras, ``EpisodeVectors.depths``.
    ahead: int = 0  # The number of frames by which actions come earlier if --ahead is not given.
