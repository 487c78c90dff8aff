"""Find faults of a set of nodes or of the environment, with their cures, without importing rclpy here.

A middleware that is not installed ends the process that requests it, so another process tries it.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from q2r2_control.events import ReasonKind
from q2r2_control.extras import install_line
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.ros.launch.build import interface_packages
from q2r2_control.ros.launch.middleware import set_up_middleware
from q2r2_control.ros.reasons import RosReason
from q2r2_control.ros.watching.set_view import SILENT, NodeView, SetView
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.teleop.arm_states import ArmState

_ONE = "end all but one (a killed one counts for some seconds)"
_START_CONTROLLER = "start the arm's controller, or set preset or ctrl_prefix to the one that runs"
_START_HANDS = "start tcp_endpoint and connect the headset, or SimulationInput"
# The launch file has to be started anew, because the driver's controllers keep their last command, and its hardware
# cannot be activated again.
FRI_CURE = "start the application on the pendant, and the driver's launch file anew: it ends with each session"
_BAD_STATES = (
    *(
        SupervisionReason.NO_STATES_YET,
        SupervisionReason.STATES_SILENT,
        SupervisionReason.STATE_NOT_FINITE,
        SupervisionReason.STATE_JUMPED,
    ),
    *(RosReason.BAD_JOINT_STATES, RosReason.NO_EXTERNAL_TORQUES),
)
# The cure, by the kind of the fault.
_CURES: dict[ReasonKind, str] = {
    **dict.fromkeys(
        (RosReason.NO_SUBSCRIBER, RosReason.SUBSCRIBER_UNKNOWN, RosReason.CONTROLLER_ABSENT), _START_CONTROLLER
    ),
    RosReason.NO_TOOL_POSE: (
        "start the robot or robot_state_publisher, or look whether its transforms have stopped; parameters "
        "end_effector_link_name, world_frame_id"
    ),
    RosReason.NO_TRANSFORM: "start what publishes that frame; parameters base_frame_id, world_frame_id",
    **dict.fromkeys((RosReason.HAND_SILENT, RosReason.HAND_UNKNOWN), _START_HANDS),
    **dict.fromkeys((RosReason.SEVERAL_PUBLISHERS, RosReason.FRAME_DISPUTED), _ONE),
    **dict.fromkeys((FriReason.FRI_SESSION, FriReason.FRI_SILENT, FriReason.FRI_COMMAND_MODE), FRI_CURE),
    **dict.fromkeys(_BAD_STATES, "look at the robot's driver, and at joint_states_topic of cartesian_controller"),
}
# Kinds of faults whose sentences already name the cure, as the sentences of a stopped arm do.
_CURE_IN_SENTENCE = {RosReason.CONTROLLER_REFUSES, RosReason.CONTROLLER_DEACTIVATED}
_SEE = "docs/ros.md, What moves an arm, and what stops it"


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault and its cure, in one line each."""

    stops_arms: bool  # Whether the fault keeps arms from moving, or stops them.
    what: str
    cure: str


def error(what: str, cure: str) -> Finding:
    return Finding(True, what, cure)


def examine_set(view: SetView, expected: Collection[str]) -> list[Finding]:
    """Return the findings of a set of nodes; [] if no node runs.

    ``expected`` are the last parts of the names of expected nodes, such as ``left_arm_controller``.
    """
    if not view.nodes:
        return []
    return [*_nodes(view, expected), *_senders(view), *_receivers(view), *_arms(view)]


def _nodes(view: SetView, expected: Collection[str]) -> Iterator[Finding]:
    for name, count in Counter(view.names).items():
        if count > 1:
            yield error(f"{count} nodes are called {name}", _ONE)
    if "cartesian_controller" in expected and not any(node.is_controller for node in view.nodes):
        yield error("no built-in controller runs", "start cartesian_controller, or q2r2 ros up")
    states = [topic for topic in view.topics if topic.name.rpartition("/")[2] == "joint_states"]
    if "mujoco_robot" in expected and not any(topic.publishers for topic in states):
        yield error("nothing publishes joint states", "start the robot's driver, or mujoco_robot")
    for node in view.nodes:
        if node.age > SILENT:
            yield error(f"{node.name} is silent for {node.age:.0f} s", "restart it; its log says how it ended")
        elif node.clock_problem:
            cure = "start what publishes /clock, or start the node without use_sim_time"
            yield error(f"{node.name}: {node.clock_problem}", cure)
        elif node.level == "error" and node.arm is None:
            yield error(f"{node.name}: {node.message}", _cure(node, node.message))


def _senders(view: SetView) -> Iterator[Finding]:
    controllers = {node.name: node for node in view.nodes if node.is_controller}
    counted = {topic for node in view.nodes for topic in node.sent}
    for topic in view.topics:
        if len(topic.types) > 1:
            types = ", ".join(topic.types)
            yield error(f"{topic.name} has {len(topic.types)} types: {types}", "rename one of the topics")
        if topic.name not in counted or len(topic.publishers) < 2:
            continue
        arms = [controllers[name].arms for name in topic.publishers if name in controllers]
        if len(arms) == len(topic.publishers) and len(set().union(*arms)) == sum(map(len, arms)):
            continue  # This is no fault, because each of these controllers has its own arm.
        yield error(f"{len(topic.publishers)} publishers of {topic.name}: {', '.join(topic.publishers)}", _ONE)
    for robot in (node.name for node in view.nodes if node.is_robot):
        topics = [topic for topic in view.topics if robot in topic.subscribers and topic.publishers]
        if len({topic.publishers for topic in topics}) > 1:
            names = ", ".join(f"{topic.name} from {' and '.join(topic.publishers)}" for topic in topics)
            yield error(f"{robot} is commanded by several: {names}", _ONE)


def _receivers(view: SetView) -> Iterator[Finding]:
    controllers = {node.name for node in view.nodes if node.is_controller}
    senders = [node for node in view.nodes if node.arm is not None or node.is_controller]
    counted = {topic for node in senders for topic in node.sent}
    for topic in view.topics:
        if topic.name not in counted or len(topic.subscribers) < 2:
            continue
        names = ", ".join(topic.subscribers)
        if len(controllers.intersection(topic.subscribers)) > 1 or len(set(topic.subscribers)) == 1:
            yield error(f"two controllers take {topic.name}: {names}", _ONE)
        else:
            what = f"{topic.name} has {len(topic.subscribers)} takers: {names}"
            yield Finding(False, what, "end those that only look: a listener counts as a controller or driver")


def _arms(view: SetView) -> Iterator[Finding]:
    said = {node.name: node for node in view.nodes}
    for arm in view.arms:
        node = said.get(arm.node)
        if node is None:
            yield error(f"the {arm.name} arm: {arm.why}", f"start {arm.name}_arm_controller, or q2r2 ros up")
        elif not (node.age > SILENT or node.clock_problem or node.values.get("ready") or node.values.get("engaged")):
            yield error(f"the {arm.name} arm: {arm.why}", _cure(node, arm.why))


def _cure(node: NodeView, line: str) -> str:
    """Return the cure for the fault that a node reports, or ``line`` if this line already contains the cure."""
    kind = node.values.get("kind")
    if kind in _CURE_IN_SENTENCE or node.values.get("state") == ArmState.STOPPED:
        return line
    return next((cure for known, cure in _CURES.items() if known == kind), _SEE)


# Packages that the nodes import, besides the packages under ``interfaces``.
PACKAGES = (
    *("rclpy", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "rcl_interfaces"),
    *("sensor_msgs", "std_msgs", "std_srvs", "trajectory_msgs", "visualization_msgs"),
)
_GREATEST_DOMAIN = 232
# Another process runs this code, which starts a node. For each message package, it also executes the code that its
# argument contains. Its last line of output is one JSON object.
_TRY = """
import json, sys
import rclpy
from rclpy.utilities import get_rmw_implementation_identifier
rclpy.init(args=[])
rclpy.create_node("q2r2_doctor_try", enable_rosout=False)
lacking = []
for name, proof in json.loads(sys.argv[1]).items():
    try:
        exec(proof)
    except Exception:
        lacking.append(name)
print(json.dumps({"middleware": get_rmw_implementation_identifier(), "lacking": lacking}))
"""
_INSTALL = f"{install_line('ros')}, or source a ROS 2 Jazzy"


def examine_environment(environment: Mapping[str, str]) -> tuple[dict[str, str], list[Finding]]:
    """Return facts by name, and findings; ``environment`` has the environment variables as the user has set them."""
    findings = []
    domain = environment.get("ROS_DOMAIN_ID") or "0"
    if not (domain.isdecimal() and int(domain) <= _GREATEST_DOMAIN):
        cure = f"export ROS_DOMAIN_ID=<0 .. {_GREATEST_DOMAIN}>, the same in every terminal"
        findings.append(error(f"ROS_DOMAIN_ID is {domain!r:.40}", cure))
    if (distribution := environment.get("ROS_DISTRO", "jazzy")) != "jazzy":
        what = f"ROS {distribution} is sourced; the nodes are made for jazzy"
        findings.append(Finding(False, what, "source a ROS 2 Jazzy"))
    peers = environment.get("ROS_STATIC_PEERS")
    reaches = (environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET") + (f", and {peers}" if peers else "")
    if environment.get("ROS_LOCALHOST_ONLY") == "1":
        reaches = "this machine only (ROS_LOCALHOST_ONLY)"
    facts = {
        "python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "ros": environment.get("ROS_DISTRO") or "not sourced: from this Python environment",
        "domain": domain,
        "middleware": environment.get("RMW_IMPLEMENTATION") or "the default",
        "reaches": reaches,
    }
    if missing := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
        findings.append(error(f"Python cannot import {', '.join(missing)}", _INSTALL))
    packages = {package.name: package.proof for package in interface_packages()}
    lacking = [name for name in packages if importlib.util.find_spec(name) is None]
    if "rclpy" not in missing and not any(finding.stops_arms for finding in findings):
        answer = _try_ros(environment, packages)
        if isinstance(answer, Finding):
            findings.append(answer)
        else:
            facts["middleware"], lacking = answer["middleware"], answer["lacking"]
    # Zenoh has no acknowledgements. Middlewares on it report that all was acknowledged, even if a receiver hangs.
    if "zenoh" in facts["middleware"]:
        what = f"{facts['middleware']} has no acknowledgements: a receiver that hangs is not noticed by that"
        findings.append(Finding(False, what, "export RMW_IMPLEMENTATION=rmw_fastrtps_cpp or rmw_cyclonedds_cpp"))
    if lacking:
        what = f"the messages of {', '.join(lacking)} cannot be imported"
        findings.append(error(what, "q2r2 ros build-interfaces"))
    return facts, findings


def _try_ros(environment: Mapping[str, str], packages: Mapping[str, str]) -> dict[str, Any] | Finding:
    """Start a node in another process, which also tries all ``packages``.

    Return the answer of this process, or a finding that says why it could start no node.
    """
    own = dict(environment)
    set_up_middleware(own)
    try:
        run = subprocess.run(
            [sys.executable, "-c", _TRY, json.dumps(packages)], env=own, capture_output=True, text=True, timeout=60.0
        )
    except subprocess.TimeoutExpired:
        return error("a node does not start within 60 s", "look for what else takes this machine's processors")
    if run.returncode == 0:
        answer: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
        return answer
    lines = [line for line in run.stderr.splitlines() if line.strip()]
    wanted = environment.get("RMW_IMPLEMENTATION")
    cure = f"unset RMW_IMPLEMENTATION, or install {wanted}" if wanted else _INSTALL
    return error(f"no node can start: {lines[-1] if lines else f'exit code {run.returncode}'}"[:300], cure)
