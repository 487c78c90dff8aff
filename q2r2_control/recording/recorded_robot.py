"""The robot of a recording, built from the cell that was recorded, and where its tools were."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from q2r2_control.config.cell import Config, parse_config
from q2r2_control.errors import Q2R2Error, RecordingError
from q2r2_control.recording.encoder import RecordedRobot
from q2r2_control.recording.reader import Recording
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_SAME_POSE = 1e-6  # [m], and of a quaternion


def cell_and_robot_of(recording: Recording, config: Config | None = None) -> tuple[Config, Robot]:
    """The recorded cell, or ``config``, with its robot.

    Raises :class:`RecordingError`, which names the file, where the recorded cell cannot be built or either one has
    other arms or joints, and :class:`Q2R2Error` where ``config`` cannot be built.
    """
    about = recording.about
    if config is not None:
        cell, robot = config, Robot.from_config(config)
    else:
        try:
            cell, robot = _built(about.cell)
        except Q2R2Error as error:
            raise RecordingError(f"{recording.file}: {error}") from error
    if tuple(robot.arms) != about.arms or tuple(robot.joint_names) != about.joints:
        raise RecordingError(f"{recording.file}: recorded with other arms or joints than {cell.name} has")
    return cell, robot


@lru_cache(maxsize=4)
def _built(text: str) -> tuple[Config, Robot]:
    """Recordings of a day have the same cell."""
    config = parse_config(text, "its cell")
    return config, Robot.from_config(config)


def check_tools(positions: Array, tools: Array, robot: Robot) -> None:
    """Raises :class:`RecordingError` where tools that were recorded, (arms, 7), are not at joint positions (joints,).

    So another robot, whose files have changed since, shows.
    """
    (found,) = tool_poses(positions[None], robot)
    near = np.minimum(np.abs(found - tools), np.abs(found + tools))[:, 3:].max() < _SAME_POSE  # q and -q are the same
    if not near or np.abs(found - tools)[:, :3].max() > _SAME_POSE:
        raise RecordingError("the robot that its cell names now is not the recorded one: tools are elsewhere")


def tool_poses(positions: Array, robot: Robot) -> Array:
    """(n, arms, 7) x y z [m] qx qy qz qw of the tools in the world, at joint positions (n, joints)."""
    return RecordedRobot.of(robot).tool_poses(positions)
