"""Episodes with a video, of which every picture is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.kept_pictures import KeptAs, KeptPictures, place_of
from q2r2_control.export.pictures import Pixels
from q2r2_control.export.video import encode

CAMERA, WIDTH, HEIGHT = "front", 64, 48


def pictures_of(episode: EpisodeVectors, seed: int) -> list[Pixels]:
    """One for each frame: a smooth pattern, which the encoder keeps, that moves."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    patterns = []
    for frame in range(episode.frames):
        waves = [np.sin(0.1 * x + 0.07 * (channel + 1) * y + 0.3 * frame + seed) for channel in range(3)]
        patterns.append((128 + 100 * np.stack(waves, axis=-1)).astype(np.uint8))
    return patterns


def save_with_videos(episodes: Sequence[EpisodeVectors], folder: Path) -> tuple[list[Path], list[list[Pixels]]]:
    """Keep episodes with the video of a camera, and return their files and pictures."""
    files, pictures = [], []
    for number, episode in enumerate(episodes):
        file = folder / f"{number}.npz"
        shown = pictures_of(episode, number)
        found = encode(shown, len(shown), place_of(file, CAMERA, KeptAs.VIDEO), episode.fps)
        statistics = {name: values.tolist() for name, values in found.items()}
        replace(episode, cameras={CAMERA: KeptPictures(WIDTH, HEIGHT, statistics)}).save(file)
        files.append(file)
        pictures.append(shown)
    return files, pictures
