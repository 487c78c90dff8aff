"""ROS 2: the nodes, and what connects them to the rest of the package, which needs no rclpy.

From the bottom up: ``launch`` starts nodes as processes, ``base_node`` is what every node has, ``monitoring`` watches
other nodes, ``bridge`` turns messages into data and back, ``nodes`` has one module for each executable. Each room
imports only those before it. ``interfaces`` holds message packages to build, no Python.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from q2r2_control.ros.base_node import BaseNode, run_node
    from q2r2_control.ros.nodes.base_arm_controller import BaseArmController

__all__ = ["BaseArmController", "BaseNode", "run_node"]

_MODULES = {"BaseArmController": "nodes.base_arm_controller", "BaseNode": "base_node", "run_node": "base_node"}


def __getattr__(name: str) -> Any:
    """Import rclpy and a node only when asked for: ``q2r2 ros up`` and the launch file do without."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
