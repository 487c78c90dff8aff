"""The nodes, one module for each executable, of the same name where the language allows it.

``base_arm_controller`` teleoperates one arm and is what a robot's own arms are derived from, as ``left_arm_controller``
and ``right_arm_controller`` are, and ``arm_controllers`` is both in one process; ``cartesian_controller`` is the built-
in controller; ``mujoco_robot`` is the simulated robot; ``tcp_endpoint`` serves the headset; ``simulation_input``
(SimulationInput) replaces it by a script; ``recorder`` keeps what they publish; ``check_tcp_connection``
(CheckTCPconnection) shows what arrives. A node is imported when its name is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.ros.nodes.base_arm_controller import BaseArmController
    from q2r2_control.ros.nodes.cartesian_controller import CartesianControllerNode
    from q2r2_control.ros.nodes.check_tcp_connection import CheckTcpConnection
    from q2r2_control.ros.nodes.left_arm_controller import LeftArmController
    from q2r2_control.ros.nodes.mujoco_robot import MujocoRobot
    from q2r2_control.ros.nodes.recorder import Recorder
    from q2r2_control.ros.nodes.right_arm_controller import RightArmController
    from q2r2_control.ros.nodes.simulation_input import SimulationInput
    from q2r2_control.ros.nodes.tcp_endpoint import TcpEndpoint

__all__ = [
    "BaseArmController",
    "CartesianControllerNode",
    "CheckTcpConnection",
    "LeftArmController",
    "MujocoRobot",
    "Recorder",
    "RightArmController",
    "SimulationInput",
    "TcpEndpoint",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "BaseArmController": "base_arm_controller",
        "CartesianControllerNode": "cartesian_controller",
        "CheckTcpConnection": "check_tcp_connection",
        "LeftArmController": "left_arm_controller",
        "MujocoRobot": "mujoco_robot",
        "Recorder": "recorder",
        "RightArmController": "right_arm_controller",
        "SimulationInput": "simulation_input",
        "TcpEndpoint": "tcp_endpoint",
    },
)
