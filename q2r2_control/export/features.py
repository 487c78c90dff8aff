"""Named vectors of what frames hold: what a dataset calls features."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.errors import RecordingError
from q2r2_control.recording.recorded_ticks import check_tools, tool_poses
from q2r2_control.recording.tick_rows import NOT_MEASURED, POSE_FIELDS
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

Vectors = dict[str, npt.NDArray[np.float32]]
Names = dict[str, tuple[str, ...]]

MOTION = ("x", "y", "z", "rx", "ry", "rz")


def features(frames: Mapping[str, Array], robot: Robot) -> tuple[Vectors, Names]:
    """The vectors (n, size) of n frames by feature, and the names of their numbers.

    ``frames`` are those of :func:`sample`. Grippers that the plant does not measure, or that are not commanded, are
    left out. Raises :class:`RecordingError`, without the file's name, for what is not a number, and where the robot is
    not the one that was recorded.
    """
    arms, joints = tuple(robot.arms), robot.joint_names
    check_tools(frames["reference"][0], frames["reference_tool"][0], robot)
    measured = _known(frames, "opening", arms)
    commanded = _known(frames, "gripper", arms)
    tools = _continuous(tool_poses(frames["position"], robot))
    targets = _continuous(frames["target"], tools[0])
    poses = tuple(f"{arm}_{number}" for arm in arms for number in POSE_FIELDS)
    count = len(tools)
    made: dict[str, tuple[Array, tuple[str, ...]]] = {
        "observation.state": (
            np.hstack((frames["position"], frames["opening"][:, measured])),
            (*joints, *(f"{arms[index]}_gripper" for index in measured)),
        ),
        "observation.velocity": (frames["velocity"], joints),
        "observation.effort": (frames["effort"], joints),
        "observation.tool": (tools.reshape(count, -1), poses),
        "action": (
            np.hstack((frames["reference"], frames["gripper"][:, commanded])),
            (*joints, *(f"{arms[index]}_gripper" for index in commanded)),
        ),
        "action.tool": (targets.reshape(count, -1), poses),
        "action.tool_delta": (
            _to_next(targets).reshape(count, -1),
            tuple(f"{arm}_{number}" for arm in arms for number in MOTION),
        ),
    }
    for name, (values, labels) in made.items():
        if not (finite := np.isfinite(values)).all():
            frame, column = np.argwhere(~finite)[0]
            raise RecordingError(f"{name}[{labels[column]}] is no finite number at frame {frame}")
    return {name: values.astype(np.float32) for name, (values, _) in made.items()}, {
        name: labels for name, (_, labels) in made.items()
    }


def _known(frames: Mapping[str, Array], what: str, arms: tuple[str, ...]) -> list[int]:
    """Arms of which there is an opening at every frame; those of which there never is one have no gripper."""
    unknown = frames[what] == NOT_MEASURED
    for index, arm in enumerate(arms):
        if unknown[:, index].any() and not unknown[:, index].all():
            raise RecordingError(f"the {what} of arm {arm} is not known at frame {np.argmax(unknown[:, index])}")
    return [index for index in range(len(arms)) if not unknown[:, index].any()]


def _continuous(poses: Array, first: Array | None = None) -> Array:
    """The same poses (n, arms, 7), with quaternions that do not change sign from frame to frame.

    q and -q are one rotation, but far apart for whoever learns them. The first has the sign of ``first`` (arms, 7), or
    else its largest number is positive.
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
    """Motion (n, arms, 6) from each pose to that of the next frame, in the frame of the former; none for the last.

    Translation [m] and rotation vector [rad].
    """
    motions = np.zeros((*poses.shape[:2], 6))
    for index in range(poses.shape[1]):
        placements = [pin.XYZQUATToSE3(pose) for pose in poses[:, index]]
        for frame, (now, then) in enumerate(pairwise(placements)):
            motion = now.actInv(then)
            motions[frame, index] = *motion.translation, *pin.log3(motion.rotation)
    return motions
