"""The data about a cell's robot that are sent to a process, so that the process can draw it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from q2r2_control.config.cell import Config
from q2r2_control.device_words import DeviceWords
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.viewer.arm_words import ArmWords


@dataclass(frozen=True)
class ShownRobot:
    """The data from which a tree of joints with meshes is built."""

    config: Config
    urdf: str
    joint_names: tuple[str, ...]
    joints: Mapping[str, Array]  # For each arm, the indices of its joints in ``joint_names``.
    fingers: Mapping[str, tuple[str, ...]]  # For each arm, the joints of its gripper.

    @classmethod
    def of(cls, robot: Robot, config: Config) -> Self:
        return cls(
            config=config,
            urdf=robot.urdf,
            joint_names=robot.joint_names,
            joints={arm: its.joints for arm, its in robot.arms.items()},
            fingers={arm: its.finger_joints for arm, its in robot.arms.items()},
        )

    def words(self, device: DeviceWords) -> ArmWords:
        """Return an instance that makes sentences about the arms, in the words of the ``device`` that drives them."""
        joints = {arm: [self.joint_names[index] for index in its] for arm, its in self.joints.items()}
        return ArmWords(joints, self.config.teleop.bindings, device)
