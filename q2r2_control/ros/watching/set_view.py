"""A set of nodes at one moment: the reports of its nodes, its topics in the graph, and a sentence on each arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from q2r2_control.config.bindings import Action
from q2r2_control.config.cell import Config
from q2r2_control.device_words import QUEST_WORDS
from q2r2_control.events import Reason
from q2r2_control.teleop.arm_states import AT_REST, ArmState
from q2r2_control.wording import sentence

SILENT = 2.0  # A node without a report for this time is silent. Nodes report twice a second [s].
_SLIPPED = 0.005  # If leash and workspace hold the target back by more than this, the arm counts as held up [m].
# Texts for states in which the arm moves already, or in which nothing is wrong.
_MOVES = {
    ArmState.CARRIED: "goes with the other arm",
    ArmState.HOMING: "goes home",
    ArmState.PAUSING: "pauses, unless the press becomes another gesture",
    ArmState.ALIGNING: "is being aligned: release both buttons to go on",
}


@dataclass(frozen=True, slots=True)
class NodeView:
    """What the last report of one node on ``~/state`` says."""

    name: str  # The full name.
    level: str  # One of ok, warn and error.
    message: str
    age: float  # Age of the report [s].
    values: Mapping[str, Any]

    @property
    def arm(self) -> str | None:
        """The arm that the node teleoperates, or None."""
        arm = self.values.get("arm")
        return arm if isinstance(arm, str) else None

    @property
    def is_controller(self) -> bool:
        return "phase" in self.values

    @property
    def is_robot(self) -> bool:
        return "refused_commands" in self.values

    @property
    def arms(self) -> set[str]:
        """The arms that the node controls, if any."""
        return {key.removesuffix("_state") for key in self.values if key.endswith("_state")}

    @property
    def sent(self) -> tuple[str, ...]:
        """The topics on which the node counts its messages."""
        sent = self.values.get("sent")
        return tuple(sent) if isinstance(sent, dict) else ()

    @property
    def clock_problem(self) -> str:
        problem = self.reason("clock_problem")
        return "" if problem is None else sentence(problem)

    def reason(self, key: str) -> Reason | None:
        """Return the reason that the node reports under ``key``, or None."""
        try:
            return Reason.from_json(self.values[key])
        except (KeyError, TypeError, ValueError):
            return None


@dataclass(frozen=True, slots=True)
class TopicView:
    """A topic that nodes of the set send or receive."""

    name: str
    types: tuple[str, ...]
    publishers: tuple[str, ...]  # Full names of the nodes that publish on the topic.
    subscribers: tuple[str, ...]  # Full names of the nodes that subscribe to the topic.
    rate: float | None  # Messages per second [Hz]; None if not known.


@dataclass(frozen=True, slots=True)
class ArmView:
    """One arm, and why it moves or does not move."""

    name: str
    node: str  # Full name of the arm's node; "" if none runs.
    state: str  # State of the arm's teleoperation.
    controller: str  # State of the arm in the built-in controller; "" if not reported.
    why: str  # One line: why the arm moves or does not move.


@dataclass(slots=True)
class DriverView:
    """A KUKA driver of one arm, as its topics and their publishers and subscribers show it."""

    arm: str
    command: str  # Topic of the arm's commands.
    states: dict[str, set[str]] = field(default_factory=dict)  # The types that are published on each topic of states.
    takers: set[str] = field(default_factory=set)  # Types that nodes receive on the topics of commands.
    state: Any = None  # The newest LBRState.
    description: str = ""  # The newest URDF.

    @property
    def namespace(self) -> str:
        return self.command.rpartition("/command/")[0]


@dataclass(frozen=True, slots=True)
class SetView:
    nodes: tuple[NodeView, ...]
    topics: tuple[TopicView, ...]
    names: tuple[str, ...]  # Names of all nodes in the domain. The name of a node that runs twice is listed twice.
    arms: tuple[ArmView, ...]
    drivers: tuple[DriverView, ...] = ()  # Empty if drivers were not listened to.

    @property
    def others(self) -> tuple[str, ...]:
        """The nodes without a report on ``~/state``."""
        members = {node.name for node in self.nodes}
        return tuple(name for name in self.names if name not in members)


def arm_views(nodes: tuple[NodeView, ...], cell: Config) -> tuple[ArmView, ...]:
    """Return a view for every node of an arm, and for every arm of ``cell`` without a node."""
    controller = next((node for node in nodes if node.is_controller), None)
    views = []
    for arm in cell.arms:
        found = [node for node in nodes if node.arm == arm]
        for node in found:
            said = "" if controller is None else str(controller.values.get(f"{arm}_state", ""))
            state = str(node.values.get("state", ""))
            views.append(ArmView(arm, node.name, state, said, _why(node, controller, cell)))
        if not found:
            why = f"no node teleoperates this arm: start {arm}_arm_controller, or q2r2 ros up"
            views.append(ArmView(arm, "", "", "", why))
    return tuple(views)


def _why(node: NodeView, controller: NodeView | None, cell: Config) -> str:
    values, arm = node.values, node.arm or ""
    if node.age > SILENT:
        return f"{node.name} is silent for {node.age:.0f} s: it has ended, hangs, or the network lost it"
    state = values.get("state")
    if state == ArmState.ENGAGED:
        return _why_engaged(values, controller, arm)
    if state in _MOVES:
        return _MOVES[ArmState(state)]
    if state == ArmState.STOPPED:
        return f"{node.message}; {node.name}/reset, or the control that stops, goes on"
    if state in AT_REST and values.get("ready"):
        bindings = cell.teleop.bindings
        control = bindings.words_of(Action.PAUSE_TOGGLE) or bindings.words_of(Action.DEAD_MAN)
        press = "a press" if control is None else QUEST_WORDS.noun(control)
        # The name of the state at the beginning of the text is left out, because it is shown beside this text.
        last = str(values.get("last_event", "")).removeprefix(f"{state}: ")
        return f"waits for its operator: {press} of the {values.get('hand')} hand engages (last: {last})"
    return node.message.removeprefix(f"{state}: ")


def _why_engaged(values: Mapping[str, Any], controller: NodeView | None, arm: str) -> str:
    age = values.get("hand_age")
    if isinstance(age, int | float) and age > SILENT:
        return f"engaged, but no pose of the {values.get('hand')} hand for {age:.0f} s"
    if controller is not None:
        why = controller.reason("fault") or controller.reason(f"{arm}_target_refusal")
        if why is not None:
            return f"engaged; {controller.name}: {sentence(why)}"
    slip = values.get("slip")
    if isinstance(slip, int | float) and slip > _SLIPPED:
        nearest: Mapping[str, Any] = {} if controller is None else controller.values
        distance, pair = nearest.get("closest_distance_m"), str(nearest.get("closest_pair", "")).replace("|", " | ")
        near = f"; nearest pair {pair}, {1e3 * distance:.0f} mm" if isinstance(distance, int | float) else ""
        return f"held up, {1e3 * slip:.0f} mm short of the hand{near}"
    return "follows the hand"
