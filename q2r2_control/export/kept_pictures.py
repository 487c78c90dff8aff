"""Pictures of an episode, kept in files beside it until all episodes are through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.export.pictures import pictures_at
from q2r2_control.export.pixel_files import write_pixels
from q2r2_control.export.video import encode
from q2r2_control.recording.reader import Recording


class KeptAs(StrEnum):
    """What pictures become, by the ending of their file."""

    VIDEO = "mp4"
    PIXELS = "h5"


@dataclass(frozen=True)
class KeptPictures:
    """What is said of those of one camera."""

    width: int
    height: int
    statistics: dict[str, list[float]]  # of a video's colours, by name


def place_of(episode: Path, camera: str, kind: KeptAs) -> Path:
    """Where the pictures of a camera are, of an episode that is kept in a file."""
    return episode.with_suffix(f".{camera}.{kind}")


def keep_pictures(
    recording: Recording,
    cameras: Mapping[str, CameraConfig],
    stamps: Sequence[int],
    fps: int,
    kind: KeptAs,
    episode: Path,
) -> dict[str, KeptPictures]:
    """Keep a picture for each frame, which are at ``stamps`` [ns]. Raises :class:`RecordingError`."""
    kept = {}
    for name, camera in cameras.items():
        pictures, place = pictures_at(recording, name, camera, stamps), place_of(episode, name, kind)
        statistics = {}
        if kind is KeptAs.VIDEO:
            found = encode(pictures, len(stamps), place, fps)
            statistics = {key: values.tolist() for key, values in found.items()}
        else:
            write_pixels(pictures, len(stamps), camera, place)
        kept[name] = KeptPictures(camera.width, camera.height, statistics)
    return kept
