"""Run the ticks of teleoperation for the arm nodes of a process, which share one :class:`Teleop`."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import pinocchio as pin
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from q2r2_control.config.presets import BUILTIN, RAW_WARNING, Mode
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import CommonReason, Event, Reason
from q2r2_control.recording.messages import RECORDER
from q2r2_control.ros.base_node import STEADY, STREAM_QOS, BaseNode
from q2r2_control.ros.reasons import RosReason
from q2r2_control.teleop.arm_states import HOLDING
from q2r2_control.teleop.both_arms import EpisodeMarks
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.teleop.teleop import Teleop

if TYPE_CHECKING:
    from q2r2_control.ros.nodes.base_arm_controller import BaseArmController


_TIME_PERIOD = 0.05  # Time between two checks whether simulated time stands still [s].
# Longest time to wait for an answer, for a controller to begin a motion home, and for a report of the recorder [s].
_PATIENCE = 2.0


class HomeClient:
    """Calls the controller's service ``~/home`` when the teleop layer begins a motion home, and ``~/hold`` at its end.

    No call waits for an answer.
    """

    def __init__(self, node: Node, controller: str | None) -> None:
        """``controller`` is the name of the built-in controller; None if the arms' controller cannot move them home."""
        self._name = controller
        self._home: Any = None if controller is None else node.create_client(Trigger, f"{controller}/home")
        self._hold: Any = None if controller is None else node.create_client(Trigger, f"{controller}/hold")
        self._answer: Any = None  # The future of a call; None if no service was called.
        # Time at which a motion home was requested or accepted [s]; None if there is none.
        self._since: float | None = None
        # Whether the controller reports a motion home: now, and at any time since the request.
        self._said = self._seen = False

    def update(self, teleop: Teleop, said: bool, outcome: Reason | None, now: float) -> None:
        """Advance by one tick.

        Args:
            teleop: The teleop layer.
            said: Whether the controller reports that it goes home.
            outcome: How the last motion home ended; None if that is not known.
            now: The time [s].
        """
        asked, begins, self._said = teleop.homing, said and not self._said, said
        if self._since is None and begins and not asked:  # Somebody else has called the service.
            teleop.home(now)
            if teleop.homing:
                self._answer, self._since, self._seen = None, now, True
            else:
                self._call_hold()
        elif self._since is None and asked:
            self._call_home(teleop, now)
        elif self._since is not None and not asked:
            self._since = None
            self._call_hold()
        elif self._since is not None:
            self._watch(teleop, outcome, now)

    def _watch(self, teleop: Teleop, outcome: Reason | None, now: float) -> None:
        """End the motion home if it is over, or if the controller does not begin it."""
        self._seen |= self._said
        accepted = self._answer is None or (self._answer.done() and self._answer.result().success)
        late = self._since is not None and now - self._since > _PATIENCE
        if self._seen:
            if not self._said:
                self._end(
                    teleop, now, outcome or Reason(CommonReason.HOMING_FAULT, cause=Reason(CommonReason.HOMING_ENDED))
                )
        elif accepted and late:
            self._end(teleop, now, outcome or Reason.of(RosReason.HOMING_NOT_BEGUN, controller=self._name))
        elif not accepted and self._answer.done():
            self._end(teleop, now, Reason.in_words(self._answer.result().message))
        elif late:
            self._home.remove_pending_request(self._answer)
            self._end(teleop, now, Reason.of(RosReason.NO_ANSWER, service=f"{self._name}/home"))

    def _call_home(self, teleop: Teleop, now: float) -> None:
        self._seen = False
        if self._home is None:
            self._end(teleop, now, Reason(RosReason.NO_WAY_HOME))
        elif not self._home.service_is_ready():
            self._end(teleop, now, Reason.of(RosReason.NO_SERVICE, service=f"{self._name}/home"))
        else:
            self._since, self._answer = now, self._home.call_async(Trigger.Request())

    def _call_hold(self) -> None:
        if self._hold is not None:
            self._hold.call_async(Trigger.Request())

    def _end(self, teleop: Teleop, now: float, outcome: Reason) -> None:
        self._since = self._answer = None
        if not self._seen:
            outcome = Reason(TeleopReason.NOT_HOMING, cause=outcome)
        teleop.end_homing(now, outcome)


class RecorderLink:
    """Listens to the report of the recorder's node: whether it records, and whether an episode is open."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._state: dict[str, Any] | None = None  # The newest report that has not been used.
        self._heard = 0.0  # Steady time of the newest report [s].
        # Number of service calls that the recorder has answered; None before its first report.
        self._served: int | None = None
        self._reasons: list[Reason] = []
        self._topic = f"{node.name_in_set(RECORDER)}/state"
        node.create_subscription(String, self._topic, self._on_state, STREAM_QOS)

    def update(self, marks: EpisodeMarks) -> list[Reason]:
        """Update the marks of episodes before the teleoperation of a tick. Return the reasons of new events."""
        if self._state is not None:
            marks.restore(self._state)
            self._state = None
        if marks.recorded and time.monotonic() - self._heard > _PATIENCE:
            marks.recorded = False
        reasons, self._reasons = self._reasons, []
        return reasons

    def _on_state(self, message: String) -> None:
        try:
            state = json.loads(message.data)
            self._state = {name: state[name] for name in EpisodeMarks().as_json()}
            if self._served is not None and state["served"] != self._served:
                self._reasons.append(Reason.from_json(state["served_last"]))
            self._served, self._heard = state["served"], time.monotonic()
        except (ValueError, TypeError, KeyError):
            self._node.drop(self._topic, f"{message.data!r:.60}")


class TickInputs(NamedTuple):
    """An arm and its controller in one tick. Poses are in the world frame."""

    tool: pin.SE3 | None  # The measured tool pose.
    commanded: pin.SE3 | None  # The tool pose in the controller's reference, or the best substitute that is known.
    reference: int | None  # Stamp of the controller's reference by the controller's clock [ns]; None if there is none.
    obstacle: Reason | None  # Why the arm may not be engaged.


class TeleopLoop:
    """Ticks the node of one arm or the nodes of both arms. One :class:`Teleop` decides for both arms in each tick."""

    def __init__(self) -> None:
        self.nodes: list[BaseArmController] = []
        self.teleop: Teleop

    def join(self, node: BaseArmController) -> None:
        """Teleoperate this node's arm as well, from the first tick on.

        Raises:
            ConfigError: If the settings of this node differ from the settings of the first node.
        """
        ours, first = node.parameters, (self.nodes or [node])[0]
        theirs = first.parameters
        for name in ("teleop", "rate", "mode", "builtin_node"):
            if getattr(ours, name) != getattr(theirs, name):
                what = "teleop, mirror and mirror_reflected" if name == "teleop" else name
                raise ConfigError(f"{what}: {first.get_name()} and {node.get_name()} differ; allowed: the same in both")
        self.nodes.append(node)
        self.teleop = Teleop(theirs.teleop, [one.arm_name for one in self.nodes])

    def connect(self, node: BaseArmController) -> None:
        """Connect a node, after its publishers and subscriptions were made."""
        if node is not self.nodes[0]:
            return
        if node.parameters.mode is Mode.RAW and node.parameters.preset is not BUILTIN:
            node.get_logger().warning(RAW_WARNING)
        self._recorder = RecorderLink(node)
        self._home = HomeClient(node, node.outputs.home_controller)
        self._ticked = node.now
        self._without_time: Reason | None = None
        node.create_tick(1.0 / node.parameters.rate, self.tick)
        # While time stands still there are no ticks, and nothing else would pause the arms.
        node.create_tick(_TIME_PERIOD, self._watch_time, clock=STEADY)

    def tick(self) -> None:
        """Process the messages that have arrived, and publish the targets of the tools."""
        decided, now, nodes, teleop = time.monotonic(), self.nodes[0].now, self.nodes, self.teleop
        for reason in self._recorder.update(teleop.marks):
            for node in nodes:
                node.feedback.haptics.start_pulse(Event(now, node.arm_name, node.state, node.state, reason))
        faults = {node.arm_name: node.begin_tick(now) for node in nodes}
        # The time is read again here, because the process may have been frozen since the start of this tick. A gap
        # between ticks of this process is handled before the faults, because such a gap makes other nodes look silent.
        gap, self._ticked = nodes[0].now - self._ticked, now
        if gap > teleop.settings.gate.timeout:
            self._pause(now, Reason.of(RosReason.NODE_STALLED, duration=gap))
        for arm, fault in faults.items():
            if fault is not None:
                teleop.pause(now, fault, arm)
        inputs = {node.arm_name: node.inputs for node in nodes}
        # Presses made while time stood still are processed only now. They may stop an arm, but never engage one.
        stood, self._without_time = self._without_time, None
        obstacles = {arm: why for arm, one in inputs.items() if (why := one.obstacle or stood) is not None}
        references = {one.reference for one in inputs.values()}
        targets = teleop.update(
            [sample for node in nodes for sample in node.intake.take()],
            {arm: one.tool for arm, one in inputs.items() if one.tool is not None},
            now,
            {arm: one.commanded for arm, one in inputs.items() if one.commanded is not None} or None,
            obstacles,
            in_step=len(references) == 1 and None not in references,
        )
        going_home = [node.outputs.homing for node in nodes]
        outcome = next((outcome for _, outcome in going_home if outcome), None)
        self._home.update(teleop, any(homing for homing, _ in going_home), outcome, now)
        for node in nodes:
            if (fault := node.follow(targets[node.arm_name], now, decided)) is not None:
                teleop.pause(now, fault, node.arm_name)
        self._publish_events()

    def change(self, settings: TeleopSettings) -> Reason | None:
        return None if settings == self.teleop.settings else self.teleop.change(settings, self.nodes[0].now)

    def _pause(self, now: float, reason: Reason) -> None:
        if any(state not in HOLDING for state in self.teleop.states.values()):
            self.teleop.pause(now, reason)

    def _watch_time(self) -> None:
        """Pause the arms if simulated time stands still. No arm may later make up for the hands' motion meanwhile."""
        timeout = self.teleop.settings.gate.timeout
        if (problem := self.nodes[0].clock_problem(timeout)) is None:
            return
        for node in self.nodes:
            node.refuse(problem)
        self._without_time = problem
        self._pause(self.nodes[0].now, problem)
        self._publish_events()

    def _publish_events(self) -> None:
        nodes = {node.arm_name: node for node in self.nodes}
        for event in self.teleop.take_events():
            nodes[event.arm].feedback.tell(event)
