"""Outputs that need the measured state: torques of the cell's impedance about the reference, and an LBR's commands."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin
from std_msgs.msg import Float64MultiArray

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.bridge.outputs import Channel, ChannelOutput
from q2r2_control.types import Array, Reference, RobotState

LBR_JOINTS = 7


class Torques:
    """Joint torques of an impedance; gravity's alone while the measured state is not trusted."""

    def __init__(self, robot: Robot, settings: ImpedanceSettings) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        self._impedance = ImpedanceController(robot, settings)

    def reset(self, state: RobotState) -> None:
        """Begin anew at a measured state."""
        self._impedance.reset(state)

    def gravity(self, state: RobotState) -> Array:
        """What bears the arms at a posture (nv,) [Nm]."""
        return np.array(pin.computeGeneralizedGravity(self._model, self._data, state.q))

    def step(self, reference: Reference, state: RobotState, dt: float, trusted: bool) -> Array:
        """Torques (nv,) [Nm] for the next ``dt`` [s], gravity and Coriolis included.

        A spring about a posture that was measured long ago could push anywhere, and many drivers repeat the last
        command for ever; gravity's torque does no harm in either case.
        """
        if trusted:
            return self._impedance.step(reference, state, dt).tau
        return self.gravity(state)


class TorqueOutput(ChannelOutput):
    """Float64MultiArray of torques in the order of the joints; gravity and Coriolis are in them.

    Arms that are pushed go astray by design, and a torque for where they are is no jump to whoever takes it next: so
    nobody is doubted.
    """

    def __init__(self, into: list[Channel], torques: Torques) -> None:
        super().__init__(into, doubts=False)
        self._torques = torques

    def activate(self, state: RobotState) -> None:
        """See :class:`Output`."""
        self._torques.reset(state)

    def send(self, reference: Reference, state: RobotState, dt: float, t: float, trusted: bool) -> None:
        """See :class:`Output`."""
        tau = self._torques.step(reference, state, dt, trusted)
        for channel in self._channels:
            channel.send(Float64MultiArray(data=tau[channel.joints].tolist()))


class LbrOutput(ChannelOutput):
    """lbr_fri_idl positions or torques, one topic an arm.

    Torques are without gravity, which the KUKA bears itself; each carries the measured position, since the driver
    ignores torques beside a position that is NaN.
    """

    def __init__(self, into: list[Channel], kind: Any, torques: Torques | None) -> None:
        for channel in into:
            if len(channel.names) != LBR_JOINTS:
                raise ConfigError(
                    f"output: {channel.publisher.topic_name} carries {len(channel.names)} joints; an LBR has "
                    f"{LBR_JOINTS}, and each needs a topic of its own"
                )
        super().__init__(into, doubts=torques is None)
        self._kind, self._torques = kind, torques

    def activate(self, state: RobotState) -> None:
        """See :class:`Output`."""
        if self._torques is not None:
            self._torques.reset(state)

    def send(self, reference: Reference, state: RobotState, dt: float, t: float, trusted: bool) -> None:
        """See :class:`Output`."""
        if self._torques is None:
            for channel in self._channels:
                channel.send(self._kind(joint_position=reference.q[channel.joints].tolist()))
            return
        overlay = self._torques.step(reference, state, dt, trusted) - self._torques.gravity(state)
        for channel in self._channels:
            q, tau = state.q[channel.joints].tolist(), overlay[channel.joints].tolist()
            channel.send(self._kind(joint_position=q, torque=tau))


def lbr_message(name: str) -> Any:
    """A message type of lbr_fri_idl. Raises :class:`ConfigError` where that package is not to be had."""
    try:
        return getattr(import_module("lbr_fri_idl.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"output: lbr_fri_idl cannot be imported ({error}); source a workspace with lbr_fri_ros2_stack, "
            "or use trajectory, float64, joint_state, torque"
        ) from error
