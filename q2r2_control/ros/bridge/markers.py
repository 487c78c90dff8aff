"""RViz markers of one arm's teleoperation: the target's axes at the tool, its path, and whether it is engaged."""

from __future__ import annotations

from collections import deque
from itertools import chain

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from q2r2_control.ros.bridge.messages import pose_message, time_message
from q2r2_control.types import Array

_AXIS_LENGTH, _AXIS_WIDTH, _PATH_WIDTH, _BALL = 0.1, 0.008, 0.004, 0.04  # [m]
_PATH_POINTS = 200
_PATH_STEP = 0.005  # between two points of the path [m]
_RGB = ((1.0, 0.1, 0.1), (0.1, 0.8, 0.1), (0.2, 0.3, 1.0))
_SIDES = {"left": (0.1, 0.6, 1.0), "right": (1.0, 0.55, 0.1)}
_OTHER_SIDE = (0.7, 0.3, 0.9)
_PAUSED = 0.35  # opacity


class TargetMarkers:
    """Markers of one arm. Axes and ball are in the tool's frame, so a paused target sits on the robot's actual pose."""

    def __init__(self, arm: str, tool_frame: str, world_frame: str) -> None:
        self._arm, self._tool_frame, self._world_frame = arm, tool_frame, world_frame
        self._colour = _SIDES.get(arm, _OTHER_SIDE)
        self._path: deque[Array] = deque(maxlen=_PATH_POINTS)

    def at(self, target: pin.SE3 | None, tool: pin.SE3 | None, engaged: bool, now: float) -> list[Marker]:
        """Markers at ``now`` [s] of a target and a tool in the world frame; none while the tool is not known."""
        if tool is None:
            return []
        shown = target if engaged and target is not None else tool
        if engaged and (not self._path or np.linalg.norm(shown.translation - self._path[-1]) > _PATH_STEP):
            self._path.append(np.array(shown.translation))
        opacity = 1.0 if engaged else _PAUSED
        in_tool = tool.inverse() * shown
        ball = self._marker("engaged", Marker.SPHERE, self._tool_frame, opacity, now)
        ball.pose = pose_message(in_tool)
        ball.scale.x = ball.scale.y = ball.scale.z = _BALL
        axes = self._marker("axes", Marker.LINE_LIST, self._tool_frame, opacity, now)
        axes.pose = pose_message(in_tool)
        axes.scale.x = _AXIS_WIDTH
        axes.points = list(chain.from_iterable((Point(), _point(row)) for row in _AXIS_LENGTH * np.eye(3)))
        axes.colors = [ColorRGBA(r=r, g=g, b=b, a=opacity) for r, g, b in _RGB for _ in range(2)]
        path = self._marker("path", Marker.LINE_STRIP, self._world_frame, opacity, now)
        path.scale.x = _PATH_WIDTH
        path.points = [_point(position) for position in self._path]
        return [ball, axes, path] if len(self._path) > 1 else [ball, axes]

    def _marker(self, name: str, kind: int, frame: str, opacity: float, now: float) -> Marker:
        marker = Marker(ns=f"{self._arm}_{name}", id=0, type=kind, action=Marker.ADD, frame_locked=True)
        marker.header.frame_id = frame
        marker.header.stamp = time_message(now)
        marker.color = ColorRGBA(r=self._colour[0], g=self._colour[1], b=self._colour[2], a=opacity)
        marker.pose.orientation.w = 1.0
        return marker


def _point(position: Array) -> Point:
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)
