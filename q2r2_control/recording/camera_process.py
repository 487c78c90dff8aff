"""The process that takes pictures: it draws and compresses them, at the lowest priority."""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.errors import PlantError
from q2r2_control.recording.helper_process import reason_of
from q2r2_control.recording.messages import Message, picture

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco_cameras import CellPictures

_NICENESS = 19  # loop and writer go first
_QUALITY = 90  # of JPEG


@dataclass(frozen=True)
class CameraSetup:
    """The first request: what pictures are taken of and where they go."""

    model: bytes  # an mujoco.MjModel, pickled: MuJoCo may look for OpenGL when it is imported
    cameras: dict[str, CameraConfig]
    channels: dict[str, int]  # of the recording's file


class PictureRequest(NamedTuple):
    """Pictures of one tick."""

    number: int  # of the tick
    time: int  # of day [ns]
    cameras: list[str]
    qpos: bytes  # float64, where everything is


def main(requests: Iterator[Any], answer: Callable[[Message | None], None]) -> None:
    """Answer None when ready, and then the message of each picture.

    Raises :class:`PlantError`, one line, where OpenGL is missing.
    """
    with suppress(OSError):
        os.nice(_NICENESS)
    setup = next(requests, None)
    if setup is None:
        return
    cell = _cell_of(setup)
    answer(None)
    for request in requests:
        cell.place(np.frombuffer(request.qpos))
        for name in request.cameras:
            payload = picture(name, request.time, _jpeg(cell, name))
            answer(Message(setup.channels[name], request.number, request.time, request.time, payload))


def _cell_of(setup: CameraSetup) -> CellPictures:
    try:
        from q2r2_control.plants.mujoco_cameras import CellPictures
    except (ImportError, AttributeError, RuntimeError) as error:
        raise PlantError(f"no pictures: MUJOCO_GL={os.environ['MUJOCO_GL']}: {reason_of(error)}") from error
    return CellPictures(pickle.loads(setup.model), setup.cameras)


def _jpeg(cell: CellPictures, name: str) -> bytes:
    packed = io.BytesIO()
    Image.fromarray(cell.take(name)).save(packed, "JPEG", quality=_QUALITY)
    return packed.getvalue()
