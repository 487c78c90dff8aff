"""Recordings for tests of the export, of which every number is known."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.recording import topics as names
from q2r2_control.recording.about import About, Conclusion, as_yaml
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.encoder import Block, in_order
from q2r2_control.recording.rows import picture_record
from tests.support.watch import cell

ARMS = ("left", "right")
JOINTS = tuple(f"{arm}_A{number}" for arm in ARMS for number in range(1, 8))
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
    changes: Mapping[tuple[str, str], npt.ArrayLike] | None = None,
    cameras: Mapping[str, CameraConfig] | None = None,
    pictures: Mapping[str, Sequence[int]] | None = None,
) -> Path:
    """A recording with ticks at ``times`` [ns] since its start.

    Measured joints are at minus the tick's place, the reference is at its place, and so are the x of tools at it;
    while engaged (places of ticks) the target of the left arm is at 1000 plus its place. ``changes``: by topic and
    field what is there instead. ``pictures``: of ``cameras``, when they were taken [ns], each brighter than the last.
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
    bag = BagWriter(path, topics.all, about)
    count = len(times)
    at = np.arange(count)
    unit = np.tile((0.0, 0.0, 0.0, 1.0), (count, 1))
    joints = np.repeat(at[:, None], len(JOINTS), axis=1).astype(np.float64)
    x = np.stack((at, 0 * at, 0 * at), axis=1).astype(np.float64)
    of_topics: dict[str, dict[str, npt.ArrayLike]] = {
        names.TICK: {},
        names.JOINT_STATES: {"position": -joints, "velocity": -10 * joints, "effort": -100 * joints},
        names.safe_target("left"): {"position": x, "quaternion": unit},
        names.safe_target("right"): {"position": x, "quaternion": unit},
        names.REFERENCE: {"positions": joints, "velocities": np.isin(at, moving)[:, None] * np.ones(len(JOINTS))},
        names.GRIPPERS: {},
        names.FLAGS: {},
    }
    for (topic, field), values in (changes or {}).items():
        of_topics[topic][field] = values
    blocks = []
    for topic, fields in of_topics.items():
        row = topics.by_name[topic]
        assert row.row is not None
        rows = row.row.rows(row.channel, count)
        for field, values in fields.items():
            rows[field] = values
        if topic == names.FLAGS:
            rows["data"][:, row.labels["data"].index("engaged_left")] = np.isin(at, engaged)
        blocks.append(Block(row, at.tolist(), rows))
    asked = topics.by_name[names.target("left")]
    assert asked.row is not None
    rows = asked.row.rows(asked.channel, len(engaged))
    if len(engaged):
        rows["position"] = x[list(engaged)] + 1000.0
        rows["quaternion"] = unit[: len(engaged)]
    blocks.append(Block(asked, list(engaged), rows))
    for block in blocks:
        assert block.rows is not None
        places = list(block.at)
        block.rows["log_time"] = block.rows["publish_time"] = EPOCH + np.array(times, dtype=np.int64)[places]
        block.rows["sequence"] = np.array(at if numbers is None else numbers)[places]
    for begin in range(0, count, CHUNK):
        inside = []
        for block in blocks:
            assert block.rows is not None
            # A slice, since numpy copies of rows have not the bytes between their fields.
            first, last = np.searchsorted(block.at, (begin, begin + CHUNK))
            if first < last:
                inside.append(Block(block.topic, block.at[first:last], block.rows[first:last]))
        bag.write(in_order(inside))
        bag.flush()
    for name, taken in (pictures or {}).items():
        shown = topics.by_name[names.picture(name)]
        for number, time in enumerate(taken):
            jpeg = plain_jpeg(config.cameras[name], brightness(number))
            bag.write([picture_record(shown.channel, number, EPOCH + time, name, jpeg)])
    bag.close(Conclusion())
    return path
