"""What is wrong with a set of nodes, and what helps: from what the graph and the nodes say at one moment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass

from q2r2_control.events import ReasonKind
from q2r2_control.ros.watching.set_view import SILENT, ArmView, NodeView, SetView, TopicView
from q2r2_control.teleop.arm_states import ArmState

_ONE = "end all but one (a killed one counts for some seconds)"
# What helps, by the kind of what is in the way.
_CURES = {
    ReasonKind.NO_SUBSCRIBER: "start the arm's controller, or set preset or ctrl_prefix to the one that runs",
    ReasonKind.NO_TOOL_POSE: (
        "start the robot or robot_state_publisher, or look whether its transforms have stopped; parameters "
        "end_effector_link_name, world_frame_id"
    ),
    ReasonKind.NO_TRANSFORM: "start what publishes that frame; parameters base_frame_id, world_frame_id",
    ReasonKind.HAND_SILENT: "start tcp_endpoint and connect the headset, or SimulationInput",
    ReasonKind.SEVERAL_PUBLISHERS: _ONE,
    ReasonKind.BAD_JOINT_STATES: "look at the robot's driver, and at joint_states_topic of cartesian_controller",
}
_SEE = "docs/ros.md, What moves an arm, and what stops it"


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is wrong, and what helps, in a line each."""

    stops_arms: bool
    what: str
    cure: str


def error(what: str, cure: str) -> Finding:
    """A finding that keeps arms from moving, or stops them."""
    return Finding(True, what, cure)


def warning(what: str, cure: str) -> Finding:
    """One that does not, or not yet."""
    return Finding(False, what, cure)


def examine_set(view: SetView, expected: Collection[str]) -> list[Finding]:
    """Findings of a set; ``expected``: names that its nodes end with, such as ``left_arm_controller``.

    None where no node of a set runs: that is no fault.
    """
    if not view.nodes:
        return []
    return [
        *_twice(view),
        *_missing(view, expected),
        *_node_findings(view.nodes),
        *_senders(view),
        *_takers(view),
        *_arm_findings(view.arms, view.nodes),
    ]


def _twice(view: SetView) -> Iterator[Finding]:
    for name, count in Counter(view.names).items():
        if count > 1:
            yield error(f"{count} nodes are called {name}", _ONE)


def _missing(view: SetView, expected: Collection[str]) -> Iterator[Finding]:
    controllers = [node for node in view.nodes if node.is_controller]
    if "cartesian_controller" in expected and not controllers:
        yield error("no built-in controller runs", "start cartesian_controller, or q2r2 ros up")
    if "mujoco_robot" in expected and not _publishers(view, "joint_states"):
        yield error("nothing publishes joint states", "start the robot's driver, or mujoco_robot")


def _node_findings(nodes: Iterable[NodeView]) -> Iterator[Finding]:
    for node in nodes:
        if node.age > SILENT:
            yield error(f"{node.name} is silent for {node.age:.0f} s", "restart it; its log says how it ended")
        elif node.clock_problem:
            cure = "start what publishes /clock, or start the node without use_sim_time"
            yield error(f"{node.name}: {node.clock_problem}", cure)
        elif node.level == "error" and node.arm is None:
            yield error(f"{node.name}: {node.message}", _cure(node, node.message))


def _senders(view: SetView) -> Iterator[Finding]:
    """Commands, targets and hands come from one node each."""
    controllers = {node.name: node for node in view.nodes if node.is_controller}
    counted = {topic for node in view.nodes for topic in node.sent}
    for topic in view.topics:
        if len(topic.types) > 1:
            yield error(
                f"{topic.name} has {len(topic.types)} types: {', '.join(topic.types)}", "rename one of the topics"
            )
        if topic.name not in counted or len(topic.publishers) < 2:
            continue
        arms = [controllers[name].arms for name in topic.publishers if name in controllers]
        if len(arms) == len(topic.publishers) and len(set().union(*arms)) == sum(map(len, arms)):
            continue  # controllers of an arm each
        yield error(f"{len(topic.publishers)} publishers of {topic.name}: {', '.join(topic.publishers)}", _ONE)
    for robot in (node.name for node in view.nodes if node.is_robot):
        topics = [topic for topic in view.topics if robot in topic.subscribers and topic.publishers]
        if len({topic.publishers for topic in topics}) > 1:
            names = ", ".join(f"{topic.name} from {' and '.join(topic.publishers)}" for topic in topics)
            yield error(f"{robot} is commanded by several: {names}", _ONE)


def _takers(view: SetView) -> Iterator[Finding]:
    """Targets and commands are for one node each."""
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
            yield warning(what, "end those that only look: a listener counts as a controller or driver")


def _arm_findings(arms: Iterable[ArmView], nodes: Iterable[NodeView]) -> Iterator[Finding]:
    said = {node.name: node for node in nodes}
    for arm in arms:
        node = said.get(arm.node)
        if node is None:
            yield error(f"the {arm.name} arm: {arm.why}", f"start {arm.name}_arm_controller, or q2r2 ros up")
        elif not (node.age > SILENT or node.clock_problem or node.values.get("ready") or node.values.get("engaged")):
            yield error(f"the {arm.name} arm: {arm.why}", _cure(node, arm.why))


def _publishers(view: SetView, base: str) -> tuple[str, ...]:
    found: Iterable[TopicView] = (topic for topic in view.topics if topic.name.rpartition("/")[2] == base)
    return tuple(dict.fromkeys(name for topic in found for name in topic.publishers))


def _cure(node: NodeView, line: str) -> str:
    """By the kind of what a node reports; a controller that refuses, and a stop, say themselves what helps."""
    kind = node.values.get("kind")
    if kind == ReasonKind.CONTROLLER_REFUSES or node.values.get("state") == ArmState.STOPPED:
        return line
    return next((cure for known, cure in _CURES.items() if known == kind), _SEE)
