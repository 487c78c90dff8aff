"""The moving obstacles of the built-in controller come as markers, which RViz also shows."""

from __future__ import annotations

from typing import Any

import pinocchio as pin
import yaml
from visualization_msgs.msg import Marker

from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import Q2R2Error, RobotError
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.messages import pose_of, seconds

TOPIC = "~/obstacles"


class ObstacleIntake:
    """Passes each :class:`Marker` to the controller. ``ns`` is the obstacle's name, ``text`` has its bounds as YAML.

    The bounds are ``speed``, ``acceleration`` and ``speed_now``, see :class:`MovingObstacle`. A cylinder becomes a
    capsule that contains it. The action DELETE removes an obstacle.
    """

    def __init__(self, node: BaseNode, controller: CartesianController) -> None:
        self._node, self._controller = node, controller
        self._said: str | None = None  # The last warning, which is not repeated.
        if controller.settings.moving_obstacles:
            node.create_subscription(Marker, TOPIC, self._on_marker, 10)

    def _on_marker(self, message: Marker) -> None:
        try:
            pair = self._controller.move_obstacle(message.ns, obstacle_of(message, self._node.now))
            text = None if pair is None else f"{message.ns} is in the way: {' | '.join(pair)}; the arms brake"
        except Q2R2Error as error:
            text = f"{TOPIC}: not used: {error}"
        if text is not None and text != self._said:
            self._node.get_logger().warning(text)
        self._said = text


def obstacle_of(message: Marker, now: float) -> MovingObstacle | None:
    """Return the obstacle of a marker that came at ``now`` [s], or None if the marker removes it.

    Raises :class:`RobotError` or :class:`ConfigError` if the marker does not describe an allowed obstacle.
    """
    if message.action in (Marker.DELETE, Marker.DELETEALL):
        return None
    pose, scale = pose_of(message.pose), message.scale
    shapes: dict[int, tuple[str, tuple[float, ...]]] = {
        Marker.CUBE: ("box", (scale.x, scale.y, scale.z)),
        Marker.SPHERE: ("sphere", (0.5 * max(scale.x, scale.y, scale.z),)),
        Marker.CYLINDER: ("capsule", (0.5 * max(scale.x, scale.y), scale.z)),
    }
    if message.type not in shapes:
        raise RobotError(f"type = {message.type}: allowed: 1 (CUBE), 2 (SPHERE), 3 (CYLINDER)")
    if pose is None or message.header.frame_id != WORLD:
        allowed = f"a finite pose with a unit quaternion in {WORLD!r}"
        raise RobotError(f"pose in {message.header.frame_id!r:.40}: allowed: {allowed}")
    try:
        bounds: Any = yaml.safe_load(message.text)
    except yaml.YAMLError:
        bounds = None
    if not isinstance(bounds, dict):
        raise RobotError(f"text = {message.text!r:.60}: allowed: bounds such as 'speed: 0.25' [m/s]")
    shape, size = shapes[message.type]
    stamp = seconds(message.header.stamp)
    age = max(now - stamp, 0.0) if stamp > 0.0 else 0.0
    place = {"position": tuple(pose.translation.tolist()), "rpy": tuple(pin.rpy.matrixToRpy(pose.rotation).tolist())}
    return MovingObstacle(**{"shape": shape, "size": size, "age": age, **bounds, **place})
