"""Check the drivers of a cell with a preset ``lbr_*`` for ``q2r2 ros doctor``: their topics, sessions and limits."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib import import_module

import numpy as np
from rclpy.node import Node
from std_msgs.msg import String

from q2r2_control.config.cell import Config
from q2r2_control.errors import RobotError
from q2r2_control.robot.description import parse_urdf
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import LATCHED_QOS, STREAM_QOS
from q2r2_control.ros.bridge.joint_outputs import KINDS
from q2r2_control.ros.bridge.lbr_driver import STATE_TOPICS, load_controller, session_fault
from q2r2_control.ros.bridge.messages import called_otherwise
from q2r2_control.ros.watching.findings import FRI_CURE, Finding, error
from q2r2_control.ros.watching.set_view import DriverView, SetView
from q2r2_control.wording import sentence

_STATE = "lbr_fri_idl/msg/LBRState"
_NEAR = 1e-6  # Tolerance of an angle [rad] and of a ratio of velocities.
_SHUT = "its driver shuts the connection beyond"


class DriverListener:
    """Listens to the states and descriptions of drivers, but not to commands. ``node`` has to be spun."""

    def __init__(self, node: Node, cell: Config) -> None:
        self._node, external = node, cell.external
        arms = () if external is None or not external.preset.startswith("lbr_") else external.arms
        self.views = [DriverView(str(arm), external.topic(arm)) for arm in arms if external is not None]
        kind = import_module("lbr_fri_idl.msg").LBRState if self.views else None
        for view in self.views:
            for name in STATE_TOPICS:
                take = partial(setattr, view, "state")
                node.create_subscription(kind, f"{view.namespace}/{name}", take, STREAM_QOS)
            topic = f"{view.namespace}/robot_description"
            node.create_subscription(String, topic, partial(self._on_description, view), LATCHED_QOS)

    def look(self) -> None:
        """Read the types of states and commands from the graph."""
        for view in self.views:
            for name in STATE_TOPICS:
                topic = f"{view.namespace}/{name}"
                view.states[topic] = {one.topic_type for one in self._node.get_publishers_info_by_topic(topic)}
            parent, _, last = view.command.rpartition("/")
            topics = [view.command, *(f"{parent}/{kind.older}" for kind in KINDS.values() if last in kind.topic)]
            view.takers = {
                one.topic_type for topic in topics for one in self._node.get_subscriptions_info_by_topic(topic)
            }

    def _on_description(self, view: DriverView, message: String) -> None:
        view.description = message.data


def examine_drivers(view: SetView, cell: Config) -> list[Finding]:
    """Return the findings of the drivers in ``view``."""
    if not view.drivers:
        return []
    robot, judged = Robot.from_config(cell), any(node.is_controller for node in view.nodes)
    return [finding for driver in view.drivers for finding in _examine(driver, cell, robot, with_session=not judged)]


def _examine(view: DriverView, cell: Config, robot: Robot, with_session: bool) -> Iterator[Finding]:
    """Yield the findings of one driver.

    Its session is judged only if ``with_session`` is True. A controller that runs judges the session itself.
    """
    assert cell.external is not None
    arm, message, topics = view.arm, cell.external.terms.message, " and ".join(view.states)
    controller = cell.external.arm(arm).ctrl_prefix.rpartition("/")[2]
    start = f"ros2 launch lbr_bringup hardware.launch.py robot_name:={view.namespace.strip('/')} ctrl:={controller}"
    kinds = set().union(*view.states.values())
    prefix = f"or let external.arms.{arm}.ctrl_prefix begin with its namespace"
    if not kinds:
        yield error(f"the {arm} arm: nobody publishes {topics}: its driver does not run", f"{start}; {prefix}")
        return
    if _STATE not in kinds:
        wrong = ", ".join(sorted(kinds))
        yield error(f"the {arm} arm: {topics} is {wrong}, the driver's is {_STATE}", f"{start}; {prefix}")
        return
    if message not in view.takers:
        others = f"takers of {', '.join(sorted(view.takers))}" if view.takers else "no taker"
        what = f"the {arm} arm: {view.command} has {others}; needed: {message}"
        yield error(what, load_controller(controller, view.namespace))
    if view.state is None:
        yield error(f"the {arm} arm: no message came on {topics}", FRI_CURE)
    elif with_session and (fault := session_fault(arm, view.state, KINDS[cell.external.preset].mode)) is not None:
        yield error(sentence(fault), FRI_CURE)
    if view.description:
        yield from _compare_limits(view, cell, robot)
    else:
        what = f"the {arm} arm: no robot_description came in {view.namespace}: its limits are not compared"
        yield Finding(False, what, f"start robot_state_publisher in {view.namespace}, as lbr_bringup does")


def _compare_limits(view: DriverView, cell: Config, robot: Robot) -> Iterator[Finding]:
    """Compare the limits of commanded positions and velocities with the limits of the driver."""
    where = f"{view.namespace}/robot_description"
    try:
        urdf = parse_urdf(view.description, where)
    except RobotError as problem:
        yield error(f"the {view.arm} arm: {problem}", "start the driver anew")
        return
    limits = {joint.get("name", ""): limit for joint in urdf.findall("joint") for limit in joint.findall("limit")}
    joints, control = robot.arms[view.arm].joints, cell.control
    ours = tuple(robot.joint_names[joint] for joint in joints)
    theirs = {name: name for name in ours}
    if not limits.keys() >= set(ours):
        theirs = called_otherwise(ours, tuple(limits), tuple(arm for arm in robot.arms if arm != view.arm))
    if not theirs:
        known = ", ".join(limits) or "none"
        cure = f"let external.arms.{view.arm}.ctrl_prefix name the driver of this arm"
        yield error(f"the {view.arm} arm: {where} has no joints for {', '.join(ours)}; it has {known}", cure)
        return
    low, high, fastest = (
        np.array([float(limits[theirs[name]].get(key, "0")) for name in ours]) for key in ("lower", "upper", "velocity")
    )
    # The limits are narrower by one step, because the driver's safe_stop allows no position from which one step leads
    # beyond a limit.
    if view.state is not None:
        low, high = low + fastest * view.state.sample_time, high - fastest * view.state.sample_time
    lower, upper = robot.position_lower[joints], robot.position_upper[joints]
    margin = np.maximum(low - lower, upper - high)
    at = int(margin.argmax())
    if margin[at] > control.position_margin + _NEAR:
        ours_low, ours_high = lower[at] + control.position_margin, upper[at] - control.position_margin
        cure = f"control.position_margin: {np.ceil(1e3 * margin[at]) / 1e3:.3f} in the YAML, or the driver's limits"
        yield error(
            f"{ours[at]} is commanded {_degrees(ours_low, ours_high)}; {_SHUT} {_degrees(low[at], high[at])}", cure
        )
    scale = fastest / robot.velocity_limit[joints]
    at = int(scale.argmin())
    if scale[at] < control.velocity_scale - _NEAR:
        speed = robot.velocity_limit[joints[at]] * control.velocity_scale
        cure = f"control.velocity_scale: {np.floor(1e3 * scale[at]) / 1e3:.3f} in the YAML, or the driver's limits"
        yield error(f"{ours[at]} is commanded up to {_degrees(speed)}/s; {_SHUT} {_degrees(fastest[at])}/s", cure)


def _degrees(*values: float) -> str:
    """Return angles [rad] as text in degrees."""
    return " to ".join(f"{np.degrees(value):.1f}" for value in values) + " deg"
