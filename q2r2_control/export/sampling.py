"""Samples frames at a fixed rate from the ticks of a recording, and makes the features of a dataset from them.

Frame k is at the time t_k = t_0 + k / fps, rounded to a nanosecond, where t_0 is the time of the first tick. Its
observations are from the newest tick at or before t_k. Its commands are from the first tick at or after t_k. Thus an
observation never contains the future, and a command was not made before the observation.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from PIL import Image, UnidentifiedImageError

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import RecordingError
from q2r2_control.inputs.policy import ActionSpace, action_names
from q2r2_control.recording.clock_steps import clock_step_text, clock_steps
from q2r2_control.recording.messages import NANOSECONDS
from q2r2_control.recording.reader import WHOLE, EpisodeSpan, Picture, Recording
from q2r2_control.recording.recorded_ticks import check_tools, tool_poses
from q2r2_control.recording.tick_rows import NOT_MEASURED, targets_or_tools
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

Columns = dict[str, npt.NDArray[Any]]
Vectors = dict[str, npt.NDArray[np.float32]]
Names = dict[str, tuple[str, ...]]
Pixels = npt.NDArray[np.uint8 | np.uint16]  # (height, width, 3) r g b 0 .. 255, or (height, width) of depth.

OBSERVED = ("position", "velocity", "effort", "opening")
COMMANDED = ("reference", "gripper", "target", "reference_tool", "intervention")
_JOINT_UNITS = {
    "observation.state": "rad",
    "observation.velocity": "rad/s",
    "observation.effort": "Nm",
    str(ActionSpace.JOINTS): "rad",
}
_FLAGS = ("intervention",)
OPENING_UNIT = "0 closed .. 1 open"
_MOVING = 0.01  # The reference counts as moving if its fastest joint is faster than this [rad/s].
# The largest age of a picture, in periods of the camera. With 2 periods, one picture may be lost.
_OLDEST = 2


def sample(recording: Recording, fps: int, trim: bool = False, span: EpisodeSpan = WHOLE) -> dict[str, Array]:
    """Return the observations and commands at each of n frames of the ``span``, by name.

    The time t_0 is the time of the first tick in the ``span``. If ``trim`` is True, it is the time of the first tick at
    which an arm is engaged or the reference moves, and the frames end with the last such tick. The result contains:

    - ``position``, ``velocity``, ``effort`` (n, joints): measured numbers [rad, rad/s, Nm].
    - ``opening`` (n, arms): measured openings of grippers, 0 closed .. 1 open; -inf if not measured.
    - ``reference`` (n, joints): the controller's reference [rad].
    - ``gripper`` (n, arms): commanded openings of grippers; -inf if not commanded.
    - ``reference_tool``, ``target`` (n, arms, 7): the tool pose at the reference, and the operator's target, as
      x y z [m] qx qy qz qw in the world. Without a target of the operator, ``target`` is ``reference_tool``.
    - ``intervention`` (n, arms): 1 where a hand moves the arm instead of a policy, otherwise 0.
    - ``time``, ``stamp`` (n,): the time since t_0 [s], and the Unix time [ns].

    Raises :class:`RecordingError` if the file is damaged, if it has no usable tick, if ticks were lost for longer than
    a frame, or if a clock was set in the ``span``.
    """
    picked: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in ("stamp", *OBSERVED, *COMMANDED)}
    start, end, count = None, 0, 0
    known: Columns = {}
    for columns in _ticks(recording, fps, span):
        # The last tick of the chunk before is kept, because it may be the newest tick for a frame in this chunk.
        known = {name: np.concatenate((known.get(name, values[:0])[-1:], values)) for name, values in columns.items()}
        passed = (columns["time"] - recording.about.epoch) / NANOSECONDS
        inside = (span.start <= passed) & (passed <= span.end)
        counting = columns["time"][inside & columns["active"] if trim else inside]
        if len(counting):
            start = int(counting[0]) if start is None else start
            end = int(counting[-1])
        if start is None:
            continue
        times = known["time"]
        due = _times_until(int(times[-1]), start, fps, count)
        count += len(due)
        picked["stamp"].append(due)
        observed = np.searchsorted(times, due, side="right") - 1
        commanded = np.searchsorted(times, due, side="left")
        for name in (*OBSERVED, *COMMANDED):
            picked[name].append(known[name][observed if name in OBSERVED else commanded])
    if not known:
        raise RecordingError(f"{recording.file}: no tick was recorded")
    if start is None:
        why = "no arm was ever engaged or moved, so --trim leaves nothing" if trim else "no tick is in the episode"
        raise RecordingError(f"{recording.file}: {why}")
    frames = {name: np.concatenate(values) for name, values in picked.items()}
    kept = frames["stamp"] <= end
    frames = {name: values[kept] for name, values in frames.items()}
    return frames | {"time": (frames["stamp"] - start) / NANOSECONDS}


def _times_until(last: int, start: int, fps: int, first_frame: int) -> npt.NDArray[np.int64]:
    """Return the rounded times [ns] of the frames from ``first_frame`` on that are not after ``last``."""
    beyond = max((last - start) * fps // NANOSECONDS + 2, first_frame)
    frames = np.arange(first_frame, beyond, dtype=np.int64)
    times = start + (frames * NANOSECONDS + fps // 2) // fps
    return times[times <= last]


def _ticks(recording: Recording, fps: int, span: EpisodeSpan) -> Iterator[Columns]:
    """Yield the columns of all ticks, chunk by chunk.

    Raises :class:`RecordingError` if ticks are missing for longer than a frame, or if a clock was set in the ``span``.
    """
    numbers = times = np.empty(0, dtype=np.int64)
    dts = np.empty(0)
    for chunk in recording.chunks():
        if not len(chunk.rows):
            continue
        numbers, times = np.append(numbers[-1:], chunk.numbers), np.append(times[-1:], chunk.times)
        lost = (np.diff(numbers) > 1) & (np.diff(times) * fps > NANOSECONDS)
        if lost.any():
            gap = int(np.argmax(lost))
            when = (int(times[gap]) - recording.about.epoch) / NANOSECONDS
            raise RecordingError(
                f"{recording.file}: {int(numbers[gap + 1] - numbers[gap]) - 1} ticks were lost after {when:.3f} s when "
                f"it was recorded; allowed: none for longer than a frame, 1/{fps} s"
            )
        dts = np.append(dts[-1:], chunk.rows["dt"])
        _check_clock(recording, span, numbers, (times - recording.about.epoch) / NANOSECONDS, dts)
        rows, arms = chunk.rows, chunk.rows["arms"]
        yield {
            "time": chunk.times,
            "active": (arms["engaged"] > 0.5).any(axis=1) | (np.abs(rows["reference_v"]).max(axis=1) > _MOVING),
            "position": rows["q"],
            "velocity": rows["v"],
            "effort": rows["tau"],
            "opening": arms["opening"],
            "reference": rows["reference_q"],
            "gripper": arms["commanded"],
            "target": targets_or_tools(rows),
            "reference_tool": arms["tool"],
            "intervention": arms["intervention"],
        }


def _check_clock(recording: Recording, span: EpisodeSpan, numbers: npt.NDArray[np.int64], t: Array, dt: Array) -> None:
    """Raise :class:`RecordingError` if a clock was set in the ``span``, or was set back to a time in it."""
    steps = clock_steps(numbers, t, dt)
    for at in np.flatnonzero(steps):
        first, last = sorted(t[at - 1 : at + 1])
        if span.start < last and span.end > first:
            raise RecordingError(
                f"{recording.file}: {clock_step_text(steps[at])} after {t[at - 1]:.3f} s, so nobody knows the times of "
                "its frames; allowed: episodes in which no clock is set"
            )


def features(frames: Mapping[str, Array], robot: Robot) -> tuple[Vectors, Names]:
    """Return two dicts by feature: the vectors (n, size) of the n ``frames``, and the names of the vectors' numbers.

    The ``frames`` come from :func:`sample`. Grippers that the plant does not measure, or that are not commanded, are
    left out. Raises :class:`RecordingError`, without the file's name, if a number is not finite or if ``robot`` is not
    the recorded robot.
    """
    arms, joints = tuple(robot.arms), robot.joint_names
    check_tools(frames["reference"][0], frames["reference_tool"][0], robot)
    measured = _known(frames, "opening", arms)
    commanded = _known(frames, "gripper", arms)
    tools = continuous(tool_poses(frames["position"], robot))
    targets = continuous(frames["target"], tools[0])
    poses = action_names(robot, ActionSpace.TOOL)
    count = len(tools)
    made: dict[str, tuple[Array, tuple[str, ...]]] = {
        "observation.state": (
            np.hstack((frames["position"], frames["opening"][:, measured])),
            (*joints, *(f"{arms[index]}_gripper" for index in measured)),
        ),
        "observation.velocity": (frames["velocity"], joints),
        "observation.effort": (frames["effort"], joints),
        "observation.tool": (tools.reshape(count, -1), poses),
        ActionSpace.JOINTS: (
            np.hstack((frames["reference"], frames["gripper"][:, commanded])),
            (*joints, *(f"{arms[index]}_gripper" for index in commanded)),
        ),
        ActionSpace.TOOL: (targets.reshape(count, -1), poses),
        ActionSpace.TOOL_DELTA: (
            _to_next(targets).reshape(count, -1),
            action_names(robot, ActionSpace.TOOL_DELTA),
        ),
        "intervention": (frames["intervention"], arms),
    }
    for name, (values, labels) in made.items():
        if not (finite := np.isfinite(values)).all():
            frame, column = np.argwhere(~finite)[0]
            raise RecordingError(f"{name}[{labels[column]}] is no finite number at frame {frame}")
    return {str(name): values.astype(np.float32) for name, (values, _) in made.items()}, {
        str(name): labels for name, (_, labels) in made.items()
    }


def units_of(names: Names) -> Names:
    """Return, by feature, the unit of each number. ``names`` come from :func:`features`."""
    return {feature: tuple(_unit(feature, label) for label in labels) for feature, labels in names.items()}


def _unit(feature: str, label: str) -> str:
    number = label.rpartition("_")[2]
    if number == "gripper":
        return OPENING_UNIT
    if feature in _FLAGS:
        return "0 or 1"
    if feature in _JOINT_UNITS:
        return _JOINT_UNITS[feature]
    return "m" if number in ("x", "y", "z") else "quaternion" if number.startswith("q") else "rad"


def _known(frames: Mapping[str, Array], what: str, arms: tuple[str, ...]) -> list[int]:
    """Return the indices of the arms whose opening is known at every frame.

    If an arm's opening is known at no frame, the arm has no gripper. Raises :class:`RecordingError` if an arm's opening
    is known only at some frames.
    """
    unknown = frames[what] == NOT_MEASURED
    for index, arm in enumerate(arms):
        if unknown[:, index].any() and not unknown[:, index].all():
            raise RecordingError(f"the {what} of arm {arm} is not known at frame {np.argmax(unknown[:, index])}")
    return [index for index in range(len(arms)) if not unknown[:, index].any()]


def continuous(poses: Array, first: Array | None = None) -> Array:
    """Return the ``poses`` (n, arms, 7) with quaternions whose signs do not change from frame to frame.

    A quaternion and its negative are the same rotation. At the first frame, the sign is chosen so that the quaternion
    is nearer to the quaternion in ``first`` (arms, 7). Without ``first``, the sign is chosen so that the quaternion's
    number with the largest absolute value is positive.
    """
    quaternions = poses[..., 3:]
    if first is None:
        largest = np.abs(quaternions[0]).argmax(axis=-1)[..., None]
        along = np.take_along_axis(quaternions[0], largest, axis=-1)[..., 0]
    else:
        along = np.sum(quaternions[0] * first[..., 3:], axis=-1)
    changes = np.concatenate((along[None], np.sum(quaternions[1:] * quaternions[:-1], axis=-1)))
    signs = np.cumprod(np.where(changes < 0.0, -1.0, 1.0), axis=0)
    return np.concatenate((poses[..., :3], quaternions * signs[..., None]), axis=-1)


def _to_next(poses: Array) -> Array:
    """Return the motion (n, arms, 6) [m, rad] from each pose to the next, in the frame of the earlier pose.

    The motion of the last pose is zero.
    """
    motions = np.zeros((*poses.shape[:2], 6))
    for index in range(poses.shape[1]):
        placements = [pin.XYZQUATToSE3(pose) for pose in poses[:, index]]
        for frame, (now, then) in enumerate(pairwise(placements)):
            motion = now.actInv(then)
            motions[frame, index] = *motion.translation, *pin.log3(motion.rotation)
    return motions


@dataclass(frozen=True)
class CameraFrames:
    """The pictures of one camera, with one picture for each frame of an episode.

    They show colours or depth. In depth, the number 0 stands for an unknown depth.
    """

    recording: Recording
    name: str
    config: CameraConfig
    stamps: Sequence[int]  # Ascending Unix times of the frames [ns].
    is_depth: bool = False

    @property
    def size(self) -> tuple[int, ...]:
        height, width = self.config.height, self.config.width
        return (height, width) if self.is_depth else (height, width, 3)

    @property
    def dtype(self) -> str:
        return "uint16" if self.is_depth else "uint8"

    @property
    def unit(self) -> float:
        """Return the unit of depth [m]."""
        return self.recording.depth_unit(self.name)

    def __iter__(self) -> Iterator[Pixels]:
        """Yield, for each frame, the newest picture at that time.

        Raises :class:`RecordingError` if the picture is older than two periods of the camera, or if there is none.
        """
        pictures = self.recording.depths(self.name) if self.is_depth else self.recording.pictures(self.name)
        newest, coming = None, next(pictures, None)
        pixels: Pixels | None = None
        for stamp in self.stamps:
            while coming is not None and coming.time <= stamp:
                newest, coming, pixels = coming, next(pictures, None), None
            age = None if newest is None else (stamp - newest.time) / NANOSECONDS
            if newest is None or age is None or age * self.config.rate > _OLDEST:
                what = "no picture yet" if age is None else f"a picture {age:.3f} s old"
                raise RecordingError(
                    f"{self.recording.file}: {self._label} has {what} at "
                    f"{(stamp - self.recording.about.epoch) / NANOSECONDS:.3f} s; allowed: at most two of its periods, "
                    f"{_OLDEST / self.config.rate:.3f} s; --no-pictures leaves them out"
                )
            if pixels is None:
                pixels = self._decoded(newest)
            yield pixels

    @property
    def _label(self) -> str:
        return f"{'depth of ' if self.is_depth else ''}camera {self.name}"

    def _decoded(self, picture: Picture) -> Pixels:
        damaged = f"{self.recording.file}: damaged: a picture of {self._label}"
        try:
            image = Image.open(io.BytesIO(picture.jpeg))
            pixels = np.asarray(image if self.is_depth else image.convert("RGB"))
        except (UnidentifiedImageError, OSError) as error:
            raise RecordingError(f"{damaged} cannot be decoded") from error
        if pixels.shape != self.size:
            raise RecordingError(f"{damaged} has a size that the cell has not")
        return pixels
