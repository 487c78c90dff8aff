"""``web_page``: shows in browsers what the nodes of a cell publish. Like the recorder, it listens to no commands.

Its buttons call services that every node may call.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from importlib import import_module
from queue import SimpleQueue
from typing import Any

import numpy as np
import pinocchio as pin
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.serde import SerdeError
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.moving_obstacle import MovingObstacle, ObstacleReport, check_obstacle
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.events import Event
from q2r2_control.recording.messages import (
    NANOSECONDS,
    PICTURE,
    RECORDER,
    TEXT,
    Message,
    Topic,
    data_of,
    hand_pose,
    heard_on,
    is_compressed,
    ros_topics,
)
from q2r2_control.recording.recorded_ticks import tool_poses
from q2r2_control.recording.ros_recording import RosTicks
from q2r2_control.recording.tick_rows import STATUSES
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import OK, RECORDED_QOS, STEADY, WARN, BaseNode
from q2r2_control.ros.bridge.obstacle_intake import TOPIC as OBSTACLES
from q2r2_control.ros.bridge.obstacle_intake import obstacle_of
from q2r2_control.ros.monitoring import NodeStates
from q2r2_control.ros.watching.set_listener import node_views
from q2r2_control.ros.watching.set_view import arm_views
from q2r2_control.summary.tick import RunStart, Tick
from q2r2_control.teleop.arm_states import HOLDING
from q2r2_control.teleop.both_arms import EpisodeMarks
from q2r2_control.types import SIDES, ArmTarget, Command, CommandMode, Reference, RobotState, StepReport
from q2r2_control.viewer.web.exchange import Frame, PageRequest
from q2r2_control.viewer.web.page import Page

_PERIOD = 1.0 / 30.0  # Time between two frames [s].
_LOOK_PERIOD = 0.5  # Time between two searches for nodes [s].
# The queue is deep enough for all ticks between two frames.
_STREAM_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
_PICTURE_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_OF_RECORDER = PageRequest.RECORD, PageRequest.MARK, PageRequest.SUBTASK
_PICTURE_PERIOD = 0.2  # Time between two pictures of a camera [s].
_UNREADABLE = SerdeError, ValueError, KeyError, IndexError, TypeError


class WebPage(BaseNode):
    """Shows the newest data that it has received, and passes on the requests of the page's buttons."""

    ticks = True

    def __init__(self) -> None:
        super().__init__("web_page")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        what = "address of the page; beyond 127.0.0.1 its URL has a token"
        host = self.parameter("web_host", "127.0.0.1", what)
        port = self.parameter("web_port", 8080, "of the page; 0: any free one", within=(0, 65535))
        rate = self.parameter("rate", 250.0, "of the controller's loop, as it is set there [Hz]", within=(20, 1000))
        recorded = self.parameter("recorded", False, "whether a recorder runs, whose buttons are shown")
        if config.external is not None and not config.external.filtered:
            allowed = "allowed: controller: builtin, or mode: filtered"
            raise ConfigError(f"--web: {config.name} has no ticks to show; {allowed}")
        self._asked: SimpleQueue[Any] = SimpleQueue()
        self._page = Page(host, port, self._asked.put)  # The page's process starts during the work below.
        self._cell, self._robot = config.model_copy(update={"loop_rate_hz": rate}), Robot.from_config(config)
        self._begun = time.monotonic_ns()
        self._ticks = RosTicks(self._begun, self._robot)
        self._waiting: list[tuple[str, Message]] = []
        self._row: Any = None  # The newest tick; None before the first one.
        self._start: RunStart | None = None
        self._events: list[Event] = []
        self._marks = EpisodeMarks()
        # The numbers of the newest tick and of the last shown tick, and the longest computing time of a tick after the
        # last shown tick [s].
        self._number, self._shown, self._slowest = -1, -1, 0.0
        self._states, self._notice = NodeStates(self, namespace=self.get_namespace()), ""
        self._controller, self._recorder = self.name_in_set("cartesian_controller"), self.name_in_set(RECORDER)
        self._trigger_clients: dict[str, Any] = {}
        requests = [PageRequest.STOP, PageRequest.RESET, PageRequest.ENGAGE, PageRequest.PAUSE, PageRequest.HOME]
        self._requests = (*requests, *(_OF_RECORDER if recorded else ()))
        self._page.open(self._robot, self._cell, config.name, self._requests)
        shown = self._ticks.topics - {hand_pose(hand) for hand in SIDES}
        for topic in ros_topics(tuple(self._robot.arms)):
            if topic.name in shown:
                name, qos = self.name_in_set(heard_on(topic.name)), RECORDED_QOS if topic.type == TEXT else _STREAM_QOS
                self._listen(name, topic.type, partial(self._take, topic), qos)
        self._obstacles: dict[str, tuple[MovingObstacle, float]] = {}  # The newest obstacles and their times [s].
        if config.control.moving_obstacles:
            self.create_subscription(Marker, OBSTACLES.replace("~", self._controller), self._on_obstacle, 10)
        self._pictures: dict[str, bytes] = {}  # The newest messages by camera.
        for camera in [name for name, its in config.cameras.items() if its.topic and is_compressed(its.topic)]:
            self._listen(
                str(config.cameras[camera].topic), PICTURE, partial(self._pictures.__setitem__, camera), _PICTURE_QOS
            )
        self.create_timer(_PICTURE_PERIOD, self._show_pictures, clock=STEADY)
        self.create_timer(_LOOK_PERIOD, self._look, clock=STEADY)
        self.create_tick(_PERIOD, self._show, clock=STEADY)
        for line in self._page.lines:
            self.get_logger().info(line)

    def _listen(self, name: str, type_name: str, take: Callable[[bytes], None], qos: QoSProfile) -> None:
        package, _, kind = type_name.split("/")
        message = getattr(import_module(f"{package}.msg"), kind)
        self.create_subscription(message, name, take, qos, raw=True)

    def _show_pictures(self) -> None:
        while self._pictures:
            camera, payload = self._pictures.popitem()
            self._page.show_picture(camera, data_of(payload, PICTURE).tobytes())

    def _take(self, topic: Topic, payload: bytes) -> None:
        self._waiting.append((topic.name, Message(topic.channel, 0, time.monotonic_ns(), 0, bytes(payload))))

    def _on_obstacle(self, marker: Marker) -> None:
        with suppress(Q2R2Error):  # The controller logs why it refuses the marker.
            obstacle, now = obstacle_of(marker, self.now), self.now
            check_obstacle(marker.ns, obstacle, self._cell.control.moving_obstacles)
            self._obstacles.pop(marker.ns, None)
            if obstacle is not None:
                self._obstacles[marker.ns] = obstacle, now

    def _look(self) -> None:
        """Look for nodes, and for their services before a button needs them."""
        self._states.look()
        names = {name for request in self._requests for name in self._services_of(request)}
        if PageRequest.RECORD in self._requests:
            names |= {f"{self._recorder}/start", f"{self._recorder}/stop"}
        for name in names - self._trigger_clients.keys():
            self._trigger_clients[name] = self.create_client(Trigger, name)

    def _services_of(self, request: PageRequest) -> list[str]:
        states = {name: state for name, (state, _) in self._states.newest.items()}
        arms = [name for name, state in states.items() if "arm" in state]
        match request:
            case PageRequest.ENGAGE:
                return [f"{arm}/engage" for arm in arms]
            case PageRequest.PAUSE:  # The pause also ends the motion home.
                return [f"{self._controller}/hold", *(f"{arm}/pause" for arm in arms)]
            case PageRequest.RESET:
                return [f"{self._controller}/reset", *(f"{arm}/reset" for arm in arms)]
            case PageRequest.RECORD:
                # The page's own marks of episodes are used if there are any, because the recorder reports its state
                # only twice a second.
                told = self._marks.open if self._marks.any else states.get(self._recorder, {}).get("episode_open")
                return [f"{self._recorder}/{'stop' if told else 'start'}"]
            case PageRequest.MARK | PageRequest.SUBTASK:
                return [f"{self._recorder}/{request}"]
        return [f"{self._controller}/{request}"]

    def _serve(self, request: PageRequest) -> None:
        self._notice = ""
        for name in self._services_of(request):
            client = self._trigger_clients.get(name)
            if client is None or not client.service_is_ready():
                self._notice = f"{name} is not there: its node does not run"
            else:
                client.call_async(Trigger.Request()).add_done_callback(partial(self._on_served, name))

    def _on_served(self, name: str, future: Any) -> None:
        if not future.result().success:
            self._notice = f"{name}: {future.result().message}"

    def _show(self) -> None:
        """Carry out the requests of the page's users, and show the newest tick."""
        while not self._asked.empty():
            self._serve(self._asked.get())
        waiting, self._waiting = self._waiting, []
        # A frame shows only the newest posture, flags and targets, but the data of all ticks and all events are used.
        try:
            chunk = self._ticks.add_messages(waiting)
        except _UNREADABLE as error:
            self.drop("one of those that the page shows", f"{error!r:.60}")
            return
        for event in (event for events in chunk.events().values() for event in events):
            self._events.append(event)
            self._marks.follow(event.kind)
        if len(chunk.rows):
            self._row, self._number = chunk.rows[-1], int(chunk.numbers[-1])
            self._slowest = max(self._slowest, float(chunk.rows["compute_time"].max()))
        if self._row is None:
            return
        # A controller that is stopped has no ticks. The newest positions of the joints are therefore written into the
        # last row.
        self._row["now"] = (time.monotonic_ns() - self._begun) / NANOSECONDS
        self._row["q"], self._row["v"], self._row["tau"] = self._ticks.joints
        nodes = node_views(self._states)
        views = arm_views(nodes, self._cell)
        # The nodes report the age of the hands' poses twice a second, and at each event.
        told = {node.arm: node.values.get("hand_age") for node in nodes}
        ages = {arm: age for arm, age in told.items() if arm is not None and isinstance(age, int | float)}
        frame = Frame(
            tick=self._tick_of(self._row.copy(), {view.name: view.state for view in views}),
            events=tuple(self._events),
            binding=(),
            ticks=self._number - self._shown,
            slowest=self._slowest,
            moved=None,
            ages=ages,
            why={view.name: view.why for view in views},
            notice=self._notice,
        )
        if self._page.send(frame):
            self._events, self._shown, self._slowest = [], self._number, 0.0

    def _tick_of(self, row: Any, states: Mapping[str, str]) -> Tick:
        now, arms = float(row["now"]), dict(zip(self._robot.arms, row["arms"], strict=True))
        state = RobotState(row["q"], row["v"], row["tau"], None, now)
        self._start = self._start or RunStart(now, state)
        controller, _ = self._states.newest.get(self._controller, ({}, 0.0))
        closest, tightest = (controller.get(f"{which}_pair", "|").split("|") for which in ("closest", "tightest"))
        report = StepReport(
            status=STATUSES[int(row["status"])],
            rejected=(),
            binding=(),
            closest_pair=tuple(closest),
            closest_distance=float(row["closest_distance"]),
            certified=bool(row["certified"]),
            fallback=bool(row["fallback"]),
            slack=float(row["slack"]),
            solve_time=float(row["solve_time"]),
            tightest_pair=tuple(tightest),
            margin=float(row["margin"]),
        )
        reference = Reference(row["reference_q"], row["reference_v"], row["reference_a"], report)
        openings = {arm: float(its["opening"]) for arm, its in arms.items() if math.isfinite(its["opening"])}
        tools = tool_poses(row["q"][None], self._robot)[0]
        return Tick(
            t=now,
            start=self._start,
            now=now,
            dt=float(row["dt"]),
            step=float(row["step"]),
            following=True,
            connected=True,
            samples=[],
            targets={arm: _target_of(its, states.get(arm) in HOLDING) for arm, its in arms.items()},
            engaged={arm: its["engaged"] > 0.5 for arm, its in arms.items()},
            states={arm: states.get(arm, "") for arm in arms},
            reference=reference,
            state=state,
            openings=openings,
            obstacles={
                name: ObstacleReport(obstacle, obstacle.age + self.now - then)
                for name, (obstacle, then) in self._obstacles.items()
            },
            tools={arm: pin.XYZQUATToSE3(pose) for arm, pose in zip(arms, tools, strict=True)},
            command=Command(CommandMode.POSITION, reference.q, reference.v, np.zeros_like(reference.q), {}),
            events=[],
            grippers=openings,
            compute_time=float(row["compute_time"]),
        )

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        if not self._page.alive:
            return WARN, f"the page is gone: {self._page.fault}", {}
        if self._row is None:
            return (
                WARN,
                "waits for joint states, the controller and the arms' nodes",
                {"url": " ".join(self._page.urls)},
            )
        return OK, f"page: {' or '.join(self._page.urls)}", {"url": " ".join(self._page.urls)}

    def close(self) -> None:
        self._page.__exit__()


def _target_of(row: Any, holds: bool) -> ArmTarget:
    pose = pin.XYZQUATToSE3(row["target"]) if row["target"].any() and not holds else None
    return ArmTarget(pose, float(row["wanted"]), float(row["slip"]), float(row["slip_angle"]))
