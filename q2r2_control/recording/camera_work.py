"""What the process that takes pictures does: draws, compresses, and hands them to the one that writes.

It ends by itself once the run's end of its standard input is closed, by a run that has ended or that was killed, with
all pictures taken that were asked for.
"""

from __future__ import annotations

import io
import os
import pickle
import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.errors import PlantError
from q2r2_control.recording.helper import be_nice, has_ended, reason_of
from q2r2_control.recording.ring import Ring
from q2r2_control.recording.rows import picture_record

if TYPE_CHECKING:
    import mujoco

    from q2r2_control.plants.mujoco_cameras import CellPictures

_NICENESS = 19  # loop and writer go first
_PERIOD = 0.02  # between two looks at the ring [s]
_PATIENCE = 10.0  # with a writer that makes no room, of a run that has ended [s]
_QUALITY = 90  # of JPEG
COPY_HEAD = struct.Struct("<3q")  # before qpos: number of the tick, its time of day [ns], a bit of each camera


@dataclass(frozen=True)
class CameraSetup:
    """What pictures are taken of and where they go."""

    model: mujoco.MjModel
    cameras: dict[str, CameraConfig]
    channels: dict[str, int]  # of the recording's file


def main(states: int, setup: int, pictures: int, open_end: int, parent: int) -> None:
    """Take pictures of one run, the one of process ``parent``.

    ``states`` and ``pictures`` are the descriptors of rings, ``setup`` of a file with a :class:`CameraSetup`, there
    with the first state. ``open_end`` tells the writer how long this process is there.
    """
    be_nice(_NICENESS)
    _take(Ring(states), setup, Ring(pictures), parent)


def _take(states: Ring, setup: int, pictures: Ring, parent: int) -> None:
    if _next(states, parent) is None:
        return
    cell, about = _cell_of(setup)
    states.release()  # ready
    count = 0
    while (record := _next(states, parent)) is not None:
        number, stamp, chosen = COPY_HEAD.unpack_from(record)
        cell.place(np.frombuffer(record, offset=COPY_HEAD.size))
        for index, (name, channel) in enumerate(about.channels.items()):
            if chosen >> index & 1:
                _put(pictures, picture_record(channel, number, stamp, name, _jpeg(cell, name)), parent)
                count += 1
        states.release()
        states.written = count
    pictures.finish()


def _cell_of(setup: int) -> tuple[CellPictures, CameraSetup]:
    """Raises :class:`PlantError`, one line, where OpenGL is missing, which MuJoCo may look for when it is imported."""
    try:
        from q2r2_control.plants.mujoco_cameras import CellPictures
    except (ImportError, AttributeError, RuntimeError) as error:
        raise PlantError(f"no pictures: MUJOCO_GL={os.environ['MUJOCO_GL']}: {reason_of(error)}") from error
    with os.fdopen(setup, "rb") as stream:
        about = pickle.load(stream)
    assert isinstance(about, CameraSetup)
    return CellPictures(about.model, about.cameras), about


def _next(states: Ring, parent: int) -> bytes | None:
    """The next record, once there is one; None when the run has ended and there is none."""
    ended = False
    while not (records := states.take(1)):
        if ended:
            return None
        ended = has_ended(parent, _PERIOD)
    return records[0]


def _jpeg(cell: CellPictures, name: str) -> bytes:
    packed = io.BytesIO()
    Image.fromarray(cell.take(name)).save(packed, "JPEG", quality=_QUALITY)
    return packed.getvalue()


def _put(pictures: Ring, record: bytes, parent: int) -> None:
    """Wait until there is room. Raises :class:`TimeoutError` where nobody is there any more to make it."""
    waiting = 0.0
    while not pictures.put(record):
        time.sleep(_PERIOD)
        waiting += _PERIOD
        if waiting > _PATIENCE and os.getppid() != parent:
            raise TimeoutError("nobody writes the pictures")
