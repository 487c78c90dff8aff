"""RViz marker of the pair of links that is closest: a line between its nearest points."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from q2r2_control.robot.compose import WORLD
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.bridge.messages import time_message
from q2r2_control.types import Array

_WIDTH = 0.006  # [m]
_FAR, _NEAR = 0.10, 0.02  # green beyond the first distance, red below the second [m]
_LIFETIME = 1  # after which RViz drops it [s]


class DistanceMarker:
    """Made where somebody listens, since Coal measures the pair once more: the controller keeps no points."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def at(self, q: Array, pair: tuple[str, str], now: float) -> Marker | None:
        """The marker at joint positions ``q`` (nv,) [rad]; None for a pair that the robot's model does not have."""
        points = self._robot.closest_points(q, pair)
        if points is None:
            return None
        share = float(np.clip((np.linalg.norm(points[1] - points[0]) - _NEAR) / (_FAR - _NEAR), 0.0, 1.0))
        marker = Marker(ns="closest_pair", type=Marker.LINE_LIST, action=Marker.ADD)
        marker.header.frame_id, marker.header.stamp = WORLD, time_message(now)
        marker.pose.orientation.w = 1.0
        marker.scale.x = _WIDTH
        marker.color = ColorRGBA(r=1.0 - share, g=share, b=0.0, a=1.0)
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
        marker.lifetime.sec = _LIFETIME
        return marker
