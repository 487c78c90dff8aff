"""Recordings for tests of the export, of which every number is known."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from q2r2_control.config.recording import CameraConfig
from q2r2_control.recording.about import About, Conclusion, as_yaml
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import ARRAY, Message, float_array, picture, serialized
from q2r2_control.recording.tick_rows import numbers_in, tick_type
from q2r2_control.recording.topics import TICK, picture_topic
from tests.recording.runs import ARMS, JOINTS
from tests.support.processes import cell

EPOCH = 1_700_000_000_000_000_000  # [ns]
CHUNK = 7  # ticks


def brightness(number: int) -> int:
    """Of the pictures that :func:`write_recording` makes."""
    return 10 * number


def plain_jpeg(camera: CameraConfig, value: int) -> bytes:
    """A picture that is grey all over."""
    packed = io.BytesIO()
    Image.new("RGB", (camera.width, camera.height), (value, value, value)).save(packed, "JPEG", quality=95)
    return packed.getvalue()


def write_recording(
    path: Path,
    times: Sequence[int],
    *,
    numbers: Sequence[int] | None = None,
    engaged: Sequence[int] = (),
    moving: Sequence[int] = (),
    openings: Mapping[str, npt.ArrayLike] | None = None,
    cameras: Mapping[str, CameraConfig] | None = None,
    pictures: Mapping[str, Sequence[int]] | None = None,
) -> Path:
    """A recording with ticks at ``times`` [ns] since its start.

    Measured joints are at minus the tick's place, the reference is at its place, and so are the x of tools at it;
    while engaged (places of ticks) the target of the left arm is at 1000 plus its place. ``openings``: by name,
    (arms,). ``pictures``: of ``cameras``, when they were taken [ns], each brighter than the last.
    """
    config = cell().model_copy(update={"cameras": dict(cameras or {})})
    about = About(
        ARMS,
        JOINTS,
        "position",
        ("position",),
        EPOCH,
        False,
        as_yaml(config),
        "<robot/>",
        tuple(config.cameras),
        {"task": "to count"},
    )
    topics = about.topics()
    count = len(times)
    at = np.arange(count)
    rows = np.zeros(count, dtype=tick_type(len(ARMS), len(JOINTS)))
    rows["index"] = at if numbers is None else numbers
    rows["q"], rows["v"], rows["tau"] = -at[:, None], -10 * at[:, None], -100 * at[:, None]
    rows["reference_q"], rows["reference_v"] = at[:, None], np.isin(at, moving)[:, None]
    arms = rows["arms"]
    arms["engaged"][:, 0] = np.isin(at, engaged)
    arms["tool"][:, :, 0], arms["tool"][:, :, 6] = at[:, None], 1.0
    arms["target"][list(engaged), 0] = arms["tool"][list(engaged), 0] + 1000.0 * np.eye(7)[0]
    for name, values in (openings or {}).items():
        arms[name] = values
    with BagWriter(path, topics.values(), about) as bag:
        for place, (row, time) in enumerate(zip(numbers_in(rows), times, strict=True)):
            payload = serialized(ARRAY, float_array(row))
            number, stamp = int(rows["index"][place]), EPOCH + time
            bag.write([Message(topics[TICK].channel, number, stamp, stamp, payload)])
            if place % CHUNK == CHUNK - 1:
                bag.flush()
        for name, taken in (pictures or {}).items():
            for number, time in enumerate(taken):
                jpeg, stamp = plain_jpeg(config.cameras[name], brightness(number)), EPOCH + time
                payload = picture(name, stamp, jpeg)
                bag.write([Message(topics[picture_topic(name)].channel, number, stamp, stamp, payload)])
        bag.close(Conclusion())
    return path
