"""Markers of moving obstacles: a valid marker becomes an obstacle, and an invalid marker causes one line."""

from __future__ import annotations

from typing import Any

import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from tests.ros.conftest import need_ros

need_ros()

from geometry_msgs.msg import Point, Pose, Vector3
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.messages import time_message
from q2r2_control.ros.bridge.obstacle_intake import ObstacleIntake


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, ControllerSettings(moving_obstacles=("hand",)))


def marker(**changes: Any) -> Marker:
    """Return a ball with a diameter of 0.2 m, far from both arms."""
    values = {"ns": "hand", "type": Marker.SPHERE, "scale": Vector3(x=0.2, y=0.2, z=0.2), "text": "speed: 0.25"}
    pose = Pose(position=Point(x=0.6, y=1.4, z=0.4))
    return Marker(**{"header": Header(frame_id="world"), "pose": pose, **values, **changes})


class Taken:
    """An obstacle intake. A call delivers a marker, and ``said`` lists the warnings that the node logs."""

    def __init__(self, context: Any, controller: CartesianController, monkeypatch: pytest.MonkeyPatch) -> None:
        self.node = BaseNode("intake", context=context)
        ObstacleIntake(self.node, controller)
        self._subscription = next(one for one in self.node.subscriptions if one.topic_name == "/intake/obstacles")
        self.said: list[str] = []
        monkeypatch.setattr(type(self.node.get_logger()), "warning", lambda _, text: self.said.append(text))

    def __call__(self, message: Marker) -> None:
        self._subscription.callback(message)


@pytest.fixture
def take(context: Any, controller: CartesianController, monkeypatch: pytest.MonkeyPatch) -> Any:
    controller.move_obstacle("hand", None)
    controller.reset(controller.robot.home)
    taken = Taken(context, controller, monkeypatch)
    yield taken
    taken.node.destroy_node()


def test_a_marker_is_an_obstacle_until_it_is_deleted(take: Taken, controller: CartesianController) -> None:
    take(marker())
    (known,) = controller.moving_obstacles.values()
    assert (known.shape, known.size, known.position, known.speed) == ("sphere", (0.1,), (0.6, 1.4, 0.4), 0.25)
    assert (known.age, known.acceleration) == (0.0, None)
    stamp = time_message(take.node.now - 0.5)
    scale = Vector3(x=0.2, y=0.2, z=0.5)
    text = "{speed: 1.0, acceleration: 5.0, speed_now: 0.1}"
    header = Header(frame_id="world", stamp=stamp)
    take(marker(header=header, type=Marker.CYLINDER, scale=scale, text=text))
    (known,) = controller.moving_obstacles.values()
    assert (known.shape, known.size, known.slower) == ("capsule", (0.1, 0.5), 0.9)
    assert known.age == pytest.approx(0.5, abs=0.3)
    take(marker(action=Marker.DELETE))
    assert controller.moving_obstacles == {}
    assert take.said == []


def test_an_obstacle_from_an_old_marker_is_as_old_as_the_markers_stamp(
    take: Taken, controller: CartesianController
) -> None:
    take(marker(header=Header(frame_id="world", stamp=time_message(take.node.now - 60.0))))
    assert controller.moving_obstacles["hand"].age >= 60.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        pytest.param({"text": ""}, "text = ''", id="no bounds"),
        pytest.param({"text": "speed: ["}, "text = 'speed: ['", id="no YAML"),
        pytest.param({"text": "sped: 1"}, "sped", id="a key that is none"),
        pytest.param({"text": "speed: .nan"}, "speed", id="no number"),
        pytest.param({"ns": "foot"}, "'foot': allowed: hand", id="a name that is none"),
        pytest.param({"type": Marker.ARROW}, "type = 0", id="a shape that is none"),
        pytest.param({"scale": Vector3()}, "size", id="no size"),
        pytest.param({"header": Header(frame_id="camera")}, "'camera'", id="a frame that is none"),
        pytest.param({"pose": Pose(position=Point(x=float("nan")))}, "pose", id="a pose that is none"),
    ],
)
def test_an_invalid_marker_is_reported_once(
    take: Taken, controller: CartesianController, changes: dict[str, Any], says: str
) -> None:
    for _ in range(3):
        take(marker(**changes))
    (line,) = take.said
    assert line.startswith("~/obstacles: not used: ")
    assert says in line
    assert controller.moving_obstacles == {}
