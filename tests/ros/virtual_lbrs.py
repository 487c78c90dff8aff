"""The node ``cartesian_controller`` between two KUKA drivers and an operator, in virtual time.

The node's callbacks are called directly: no message crosses a network, and nothing depends on how busy the machine is.
"""

from __future__ import annotations

import heapq
import itertools
import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio as pin
import rclpy
import yaml
from rclpy.clock_type import ClockType
from rclpy.logging import LoggingSeverity
from rclpy.time import Time

from q2r2_control import Robot
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.bridge import joint_outputs
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.launch.processes import nodes_of
from q2r2_control.ros.nodes.cartesian_controller import CartesianControllerNode
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.types import SIDES, Array
from tests.ros.fake_lbr import PERIOD, TAU, TOPICS, FakeLbr
from tests.support.external_cell import external

_TARGETS = 0.01  # Time between two targets of the operator [s].
_SOON, _LATE_SHARE = 0.002, 0.01  # Delivery time of messages [s], and share of messages that take longer.
_LATE = 0.25 * TAU  # Largest delay [s]. The filter's time constant bounds what the driver tolerates.


def lbr_cell(folder: Path) -> str:
    """Return a file with the shipped cell behind a driver for each arm."""
    cell = external()
    arms = {
        arm: {
            "ctrl_prefix": f"/{arm}/lbr_joint_position_command_controller",
            "base_frame": f"{arm}_link_0",
            "joint_states_topic": f"/{arm}/joint_states",
        }
        for arm in SIDES
    }
    cell["external"] |= {"preset": "lbr_position", "mode": "filtered", "arms": arms, "world_frame": WORLD}
    (file := folder / "lbr.yaml").write_text(yaml.safe_dump(cell))
    return str(file)


class DirectPublisher:
    """A replacement for :class:`WatchedPublisher` that delivers at once."""

    def __init__(self, node: Any, kind: type, topic: str, timeout: float) -> None:
        self.topic_name, self.sent = topic, 0
        self.deliver: Callable[[Any], None] | None = None

    @property
    def listeners(self) -> int:
        return int(self.deliver is not None)

    def publish(self, message: Any, decided: float) -> bool:
        self.sent += 1
        if self.deliver is not None:
            self.deliver(message)
        return True

    def begin(self, acknowledged: bool = False) -> None:
        """Begin without acknowledgements."""

    def waits(self) -> bool:
        return False

    def silence(self) -> None:
        return None


class VirtualLbrs:
    """The controller's node and a driver for each arm in virtual time. Each has its own clock."""

    def __init__(self, node: CartesianControllerNode, robot: Robot, release: str, seed: int) -> None:
        self.node, self.robot, self.random = node, robot, np.random.default_rng(seed)
        self.drivers = {arm: FakeLbr(robot, arm) for arm in SIDES}
        self.now = 1.0  # The virtual time [s].
        self._clock: Any = node.get_clock()
        self.frozen_until = 0.0  # Time until which the node is frozen [s].
        # A function that changes a driver's message on a topic. If it returns None, the message is lost.
        self.change: Callable[[str, Any], Any] = lambda topic, message: message
        self.on_command: Callable[[str, Array], None] = lambda arm, q: None
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._last: dict[str, float] = {}  # Last delivery on each topic [s].
        self._waiting: list[Callable[[], None]] = []  # Messages for a frozen node.
        self._callbacks = {one.topic_name: one.callback for one in node.subscriptions}
        command, self._state = TOPICS[release]
        outputs: dict[str, Any] = {one.publisher.topic_name: one.publisher for one in node._output._channels}
        for arm in SIDES:
            outputs[f"/{arm}/command/{command}"].deliver = partial(self._command, arm)
            own = PERIOD * (1.0 + float(self.random.uniform(-2e-4, 2e-4)))
            self._every(own, 0.0, partial(self._advance, arm))
        self._every(node._period, 0.1 * node._period, self._tick)

    def at(self, t: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (t, next(self._numbers), act))

    def run(self, done: Callable[[], bool]) -> None:
        while not done():
            self.now, _, act = heapq.heappop(self._queue)
            self._clock.set_ros_time_override(Time(seconds=self.now, clock_type=ClockType.ROS_TIME))
            act()

    def target(self, arm: str, pose: pin.SE3) -> None:
        """Deliver a target of the operator at once. If the node is frozen, it gets its messages later, in order."""
        received = int(1e9 * self.now)
        info = {"publication_sequence_number": None, "source_timestamp": received, "received_timestamp": received}
        take = self._callbacks[f"/q2r2/{arm}/target_frame"]
        self._to_node(lambda: take(stamped_pose(pose, WORLD, 0.0), info))

    def measured(self) -> Array:
        return np.concatenate([self.drivers[arm].q for arm in SIDES])

    def _every(self, period: float, jitter: float, act: Callable[[], None]) -> None:
        start = self.now + float(self.random.uniform(0.0, period))

        def again(number: int) -> None:
            act()
            due = start + (number + 1) * period + float(self.random.uniform(0.0, jitter))
            self.at(max(due, self.now), partial(again, number + 1))

        self.at(start, partial(again, 0))

    def _sent(self, topic: str, act: Callable[[], None]) -> None:
        """Deliver messages of a topic in order, mostly within 2 ms."""
        longest = _LATE if self.random.random() < _LATE_SHARE else _SOON
        self._last[topic] = max(self._last.get(topic, 0.0), self.now + float(self.random.uniform(1e-4, longest)))
        self.at(self._last[topic], act)

    def _to_node(self, act: Callable[[], None]) -> None:
        if self.now < self.frozen_until:
            self._waiting.append(act)
        else:
            act()

    def _tick(self) -> None:
        if self.now < self.frozen_until:
            return
        for act in self._waiting:
            act()
        self._waiting.clear()
        self.node._tick()

    def _command(self, arm: str, message: Any) -> None:
        self.on_command(arm, np.array(message.joint_position))
        self._sent(f"to {arm}", lambda: self.drivers[arm].take(message))

    def _advance(self, arm: str) -> None:
        driver = self.drivers[arm]
        driver.advance()
        if driver.silent:
            return
        for name, message in ((self._state, driver.state()), ("joint_states", driver.joint_state())):
            topic = f"/{arm}/{name}"
            if (changed := self.change(topic, message)) is not None:
                self._sent(topic, partial(self._to_node, partial(self._callbacks[topic], changed)))


class Operator:
    """An operator who presses a moment after both arms are ready, and releases a moment after they are not."""

    def __init__(self, virtual: VirtualLbrs) -> None:
        self._virtual, self._random = virtual, virtual.random
        self.moves = False
        self.not_before = 0.0  # Earliest time of the next press [s].
        self._began = self._ready_since = 0.0
        self._starts: dict[str, pin.SE3] = {}
        self._ways: dict[str, tuple[Array, Array, float]] = {}
        virtual.at(virtual.now, self._send)

    def _send(self) -> None:
        virtual, random = self._virtual, self._random
        virtual.at(virtual.now + _TARGETS, self._send)
        supervisor = virtual.node._supervisor
        ready, followed = supervisor.phase is Phase.ACTIVE, all(map(supervisor.follows, SIDES))
        if self.moves and not followed and random.random() < 0.1:
            self.moves, self.not_before = False, max(self.not_before, virtual.now + 0.2)
        elif not self.moves and ready and virtual.now >= self.not_before and random.random() < 0.1:
            self.moves, self._began = True, virtual.now
            self._starts = {arm: virtual.robot.tool_pose(virtual.measured(), arm) for arm in SIDES}
            # A far target is out of reach, at joint limits, or as fast as the joints can move.
            far = random.random() < 0.3
            scale = (0.8, 1.5) if far else (0.12, 0.3)
            self._ways = {
                arm: (scale[0] * random.uniform(-1, 1, 3), scale[1] * random.uniform(-1, 1, 3), random.uniform(0.3, 1))
                for arm in SIDES
            }
        for arm in SIDES if self.moves else ():
            way, turn, frequency = self._ways[arm]
            share = math.sin(2.0 * math.pi * frequency * (virtual.now - self._began))
            start = self._starts[arm]
            virtual.target(arm, pin.SE3(start.rotation @ pin.exp3(share * turn), start.translation + share * way))


@contextmanager
def virtual_lbrs(release: str, domain: int, seed: int = 0) -> Iterator[VirtualLbrs]:
    with tempfile.TemporaryDirectory() as folder:
        cell = lbr_cell(Path(folder))
        given = dict(nodes_of(cell)[0].parameters) | {"use_sim_time": True}
        arguments = [part for name, value in given.items() for part in ("-p", f"{name}:={value}")]
        rclpy.init(
            args=["--ros-args", *arguments], domain_id=domain, signal_handler_options=rclpy.SignalHandlerOptions.NO
        )
        try:
            with patch.object(joint_outputs, "WatchedPublisher", DirectPublisher):
                node = CartesianControllerNode()
            # Sessions end on purpose in these tests. The node's warnings about this are not shown.
            node.get_logger().set_level(LoggingSeverity.FATAL)
            yield VirtualLbrs(node, Robot.from_config(load_config(cell)), release, seed)
            node.get_logger().set_level(LoggingSeverity.UNSET)
            node.destroy_node()
        finally:
            rclpy.try_shutdown()
