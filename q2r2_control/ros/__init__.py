"""ROS 2: the nodes, and the code that connects them to the rest of the package, which needs no rclpy.

From the bottom up: ``launch`` starts nodes as processes, and ``executor`` spins nodes that tick. ``base_node`` is the
base class of every node, and ``monitoring`` watches other nodes. ``bridge`` converts messages into data and back.
``nodes`` has the executables, and ``watching`` observes a running set of nodes from outside. ``interfaces`` has message
packages to build.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.config.presets import Preset as Preset
    from q2r2_control.config.teleop import GuardSettings as GuardSettings
    from q2r2_control.ros.base_node import BaseNode as BaseNode
    from q2r2_control.ros.base_node import run_node as run_node
    from q2r2_control.ros.nodes.base_arm_controller import BaseArmController as BaseArmController
    from q2r2_control.ros.reasons import RosReason as RosReason

_MODULES = {
    "BaseArmController": "nodes.base_arm_controller",
    "BaseNode": "base_node",
    "GuardSettings": ".config.teleop",
    "Preset": ".config.presets",
    "RosReason": "reasons",
    "run_node": "base_node",
}
__all__ = list(_MODULES)
__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
