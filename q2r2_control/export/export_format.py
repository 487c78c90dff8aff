"""The description of a format of ``q2r2 export``.

Other packages declare their formats as entry points of the group ``q2r2_control.exports``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.export.episodes import EpisodeVectors


@dataclass(frozen=True)
class ExportFormat:
    """The functions that write episodes one by one, and then join them in the output.

    ``write(episode, path)`` writes one :class:`EpisodeVectors` as a file or a folder at ``path``. It has to be a
    module's function, since other processes import it. An incomplete file of an earlier attempt may exist at ``path``.
    ``join(paths, folder)`` makes the new ``folder`` from the written ``paths``, in their order, and may move them. Both
    raise :class:`RecordingError`, with the name of the recording, if the format cannot store an episode.
    """

    write: Callable[[EpisodeVectors, Path], None]
    join: Callable[[Sequence[Path], Path], None]
    require: Callable[[], object] = lambda: None  # Raises ConfigError if a package is not installed.
    advice: Callable[[Path], str] | None = None  # Returns a text on how to train with the output.
    has_depth: bool = False  # Whether the format stores ``EpisodeVectors.depths``, the depth of cameras.
    ahead: int = 0  # If --ahead is not given, position actions are shifted by this number of frames to earlier rows.
