"""Episodes of which every number and every picture is known."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.sampling import Pixels

NAMES = {"observation.state": ("left_A1", "left_gripper"), "action": ("left_A1", "left_gripper", "right_A1")}
OUTCOMES = {1: True, 2: None, 3: False}
CAMERA, WIDTH, HEIGHT = "front", 64, 48


def episode(seed: int, frames: int, task: str) -> EpisodeVectors:
    random = np.random.default_rng(seed)
    vectors = {name: random.normal(size=(frames, len(labels))).astype(np.float32) for name, labels in NAMES.items()}
    return EpisodeVectors(
        f"run-{seed}.mcap", "two_arms", task, 30, NAMES, {"operator": "Ada"}, vectors, success=OUTCOMES[seed]
    )


EPISODES = (episode(1, 40, "stack"), episode(2, 25, "circle"), episode(3, 60, "stack"))


@dataclass(frozen=True)
class Waves:
    """A smooth pattern, which an encoder of videos keeps, that moves from frame to frame."""

    frames: int
    seed: int
    size: tuple[int, int, int] = (HEIGHT, WIDTH, 3)

    def __iter__(self) -> Iterator[Pixels]:
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        for frame in range(self.frames):
            waves = [np.sin(0.1 * x + 0.07 * (channel + 1) * y + 0.3 * frame + self.seed) for channel in range(3)]
            yield (128 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def with_pictures(plain: EpisodeVectors, seed: int) -> EpisodeVectors:
    """The same episode, seen by a camera."""
    return replace(plain, cameras={CAMERA: Waves(plain.frames, seed)})  # type: ignore[dict-item]


def write_vectors(episode: EpisodeVectors, path: Path) -> None:
    """Keep an episode, as the formats do."""
    path.write_bytes(pickle.dumps(replace(episode, cameras={})))


def load_vectors(path: Path) -> EpisodeVectors:
    """An episode that was kept so."""
    episode: EpisodeVectors = pickle.loads(path.read_bytes())
    return episode
