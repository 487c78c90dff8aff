"""A format of ``q2r2 export``. Other packages declare theirs as entry points of ``q2r2_control.exports``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.export.episodes import EpisodeVectors


@dataclass(frozen=True)
class ExportFormat:
    """How episodes are written one by one, and then joined in the output.

    ``write(episode, path)`` makes a file or a folder of one :class:`EpisodeVectors`. It is a function of a module,
    since other processes call it, and it may find half of an earlier attempt at ``path``. ``join(paths, folder)`` makes
    the new ``folder`` of these, in their order, and may move them. Both raise :class:`RecordingError` for episodes that
    the format cannot have, with the name of the recording.
    """

    write: Callable[[EpisodeVectors, Path], None]
    join: Callable[[Sequence[Path], Path], None]
    require: Callable[[], object] = lambda: None  # raises ConfigError where a package is not installed
    advice: Callable[[Path], str] | None = None  # what a trainer wants to be told of the output
    ahead: int = 0  # frames by which actions come earlier unless --ahead says otherwise
