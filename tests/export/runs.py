"""Short recorded runs for tests of the export."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.inputs.played import EvenSampling, PlayedInput
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, HandInputs
from tests.recording.runs import file_of, pipeline, record
from tests.support.processes import Watch

STEP_AT = 0.5  # [s]
DURATION = 0.9  # [s]


@dataclass(frozen=True)
class Run:
    """A recorded run, and what was told to listeners of it."""

    file: Path
    ticks: list[Tick]


def step_of_the_hand(hand: str, t: float) -> pin.SE3:
    """Rests, and is 1 cm to the left from :data:`STEP_AT` on."""
    return pin.SE3(np.eye(3), np.array([0.0, 0.01 if t >= STEP_AT else 0.0, 0.0]))


def press(hand: str, t: float) -> HandInputs:
    """Engages, and begins to close the left gripper at the step."""
    return HandInputs(button_lower=0.1 <= t < 0.2, button_upper=hand == "left" and STEP_AT <= t < STEP_AT + 0.1)


def record_step(folder: Path, duration: float = DURATION) -> Run:
    """A run in which both arms are engaged and the hands step; the plant is where the reference was a tick before."""
    hands = PlayedInput(step_of_the_hand, press, {side: EvenSampling(100.0) for side in SIDES})
    loop = pipeline(source=hands)
    watch = Watch(loop)
    return Run(file_of(record(folder, loop, duration)), watch.ticks)


def record_two(folder: Path) -> Sequence[Path]:
    """Files of two such runs of different lengths."""
    return [record_step(folder, duration).file for duration in (DURATION, 0.6)]


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
