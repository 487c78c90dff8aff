"""The base of every node: parameters with ranges, QoS, its own state, diagnostics, and the main function."""

from __future__ import annotations

import gc
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.action import ActionClient, ActionServer
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.events import Reason
from q2r2_control.process.scheduling import (
    LONGEST_END,
    StopRequest,
    schedule_thread_as_others,
    schedule_thread_first,
)
from q2r2_control.ros.executor import TickExecutor, TickGroup
from q2r2_control.ros.launch.middleware import set_up_middleware
from q2r2_control.ros.reasons import RosReason
from q2r2_control.wording import sentence

# If a real-time process computes for this time without a sleep, Linux sends it a signal [s], because other processes
# cannot run meanwhile.
_NEVER_IDLE = 0.5
# After its nodes are closed, a process has at least this time to end [s]. To close a node takes up to 3 s, because its
# arms brake.
_LEAST_END = 2.0
_deadline = math.inf  # Time of the steady clock at which this process must have ended [s].
# The QoS profiles. Each keeps the last messages, and is reliable and volatile unless its arguments say otherwise.
# The profile of a receiver of commands. Only the newest command counts, and it must arrive.
COMMAND_QOS = QoSProfile(depth=1)
# The profile of a sender of commands. A reliable sender repeats messages that have not arrived, also after the network
# was down for a while. An old target would let the arm jump, so messages have a lifespan. It is measured by the
# sender's clock, which can differ from the receiver's clock.
SENT_COMMAND_QOS = QoSProfile(depth=1, lifespan=Duration(seconds=0.1))
# The profile of streams of a headset, of joint states or of nodes' reports, in which a late message is worth less than
# the next one. A reliable subscription delivers in order: after a lost message, later messages would wait up to 3 s.
STREAM_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
# The profile of messages that are only recorded. All of them are needed, but a late arrival does no harm.
RECORDED_QOS = QoSProfile(depth=200)
# The profile of latched messages (transient local), such as robot_description. A node that subscribes later still gets
# the last message.
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_DIAGNOSTICS_PERIOD = 0.5  # Time between two diagnostics [s].
STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # The clock of timers that go on while /clock stands still.
_CLOCK_TIMEOUT = 1.0  # Simulated time that stands still for longer than this is reported [s].

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class BaseNode(Node):
    """A node with described parameters, ``/diagnostics`` and ``~/state`` (one JSON object in a String)."""

    exit_code: int | None = None  # As soon as this exit code is set, the executable ends with it.
    ticks = False  # True if messages are taken only at the node's ticks, see TickExecutor.
    priority = 0  # Real-time priority, if the system permits it; 0 for the ordinary priority.

    def __init__(self, name: str, **kwargs: Any) -> None:
        self.tick_group = TickGroup()
        super().__init__(name, **kwargs)
        what = (
            "of SCHED_FIFO for the thread that ticks, where the system permits it; 0: as others; a process: the highest"
        )
        self.priority = self.parameter("realtime_priority", self.priority, what, within=(0, 98))
        self._diagnostics = self.create_publisher(DiagnosticArray, "diagnostics", 10)
        self._state = self.create_publisher(String, "~/state", 10)
        self._ros_time = 0.0, time.monotonic()  # The newest ROS time, and the steady time when it was first seen [s].
        self._dropped: set[str] = set()  # Topics with messages that could not be read.
        # Number of ticks since the last call of :meth:`tick_rate`, and the time of this call [s].
        self.ticked, self._counted_at = 0, time.monotonic()
        self.create_timer(_DIAGNOSTICS_PERIOD, self.report_health, clock=STEADY)

    # rclpy checks the events of every endpoint each time that it waits, which costs processor time. These events warn
    # of settings or types that do not match. Publishers get no events here, because their subscribers warn as well.
    # Best-effort subscriptions get no events either, because they match every publisher's settings.
    def create_publisher(self, *args: Any, **kwargs: Any) -> Any:
        kwargs.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*args, **kwargs)

    def create_subscription(self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **kwargs: Any) -> Any:
        if getattr(qos_profile, "reliability", None) is ReliabilityPolicy.BEST_EFFORT:
            kwargs.setdefault("event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False))
        if self.ticks and getattr(qos_profile, "durability", None) is not DurabilityPolicy.TRANSIENT_LOCAL:
            kwargs.setdefault("callback_group", self.tick_group)
        return super().create_subscription(msg_type, topic, callback, qos_profile, **kwargs)

    def create_tick(self, period: float, callback: Callable[[], None], clock: Clock | None = None) -> Any:
        """Create a timer of ``period`` [s] that runs after the callbacks of all messages that have arrived."""
        return self.create_timer(period, callback, callback_group=self.tick_group, clock=clock)

    def parameter(
        self,
        name: str,
        default: Any,
        description: str,
        *,
        within: tuple[float, float] | None = None,
        one_of: Sequence[str] = (),
        read_only: bool = True,
    ) -> Any:
        """Declare a parameter and return its value. rclpy enforces ``within``; ``one_of`` is checked at the start only.

        Raises:
            ConfigError: If the value has another type, is outside the range, or is not in ``one_of``.
        """
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        if one_of:
            descriptor.additional_constraints = f"one of {', '.join(one_of)}"
        if within is not None and isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(within[0]), to_value=int(within[1]), step=0)]
        elif within is not None:
            least, greatest = map(float, within)
            descriptor.floating_point_range = [FloatingPointRange(from_value=least, to_value=greatest, step=0.0)]
        try:
            value = self.declare_parameter(name, default, descriptor).value
        except ParameterException as error:
            allowed = "" if within is None else f"; allowed is {within[0]:g} .. {within[1]:g}"
            raise ConfigError(f"parameter {name}: {' '.join(str(error).split())}{allowed}") from None
        if one_of and value not in one_of:
            raise ConfigError(f"parameter {name}: {value!r}: allowed are {', '.join(one_of)}")
        return value

    def full_name(self, name: str) -> str:
        """Return the full name of a topic, a service or a node in this node's namespace.

        A name with a leading / is returned unchanged. The name is not remapped here, because rclpy remaps it when it
        is used.
        """
        return str(self.resolve_topic_name(name, only_expand=True)) if name else name

    def name_in_set(self, name: str) -> str:
        """Return the full name of a node or topic of the same set of nodes.

        ``name``, such as ``/recorder``, is the full name that it would have without a namespace.
        """
        return self.full_name(name.removeprefix("/"))

    @property
    def now(self) -> float:
        """Return the time of the node's clock [s]. It is ROS time, so that use_sim_time has an effect."""
        return float(self.get_clock().handle.get_now().nanoseconds) * 1e-9

    def tick_rate(self) -> float:
        """Return the rate of the ticks that a subclass has counted in ``ticked`` since the previous call [Hz]."""
        now = time.monotonic()
        rate = self.ticked / max(now - self._counted_at, 1e-9)
        self.ticked, self._counted_at = 0, now
        return round(rate, 1)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """Return the level (OK, WARN, ERROR), one line of text, and values by name, for the diagnostics."""
        return OK, "running", {}

    def drop(self, topic: str, text: str) -> None:
        """Warn, once for each topic, that a message of another node cannot be read. ``text`` describes the message."""
        if topic not in self._dropped:
            self._dropped.add(topic)
            self.get_logger().warning(sentence(Reason.of(RosReason.MESSAGE_UNREADABLE, topic=topic, text=text)))

    def report_health(self) -> None:
        """Publish :meth:`health` now. A timer calls this twice a second. Call it also after an urgent change."""
        level, line, values = self.health()
        if (problem := self.clock_problem()) is not None:
            level, line = max(level, WARN), f"{sentence(problem)}; {line}"
            values = {**values, "clock_problem": problem.as_json()}
        status = DiagnosticStatus(level=level, name=self.get_fully_qualified_name(), message=line)
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)
        state = {"level": {OK: "ok", WARN: "warn", ERROR: "error"}[level], "message": line, **values}
        self._state.publish(String(data=json.dumps(state, default=str)))

    def close(self) -> None:
        """Close the node. It is called at the end, while the node can still publish."""

    def destroy_node(self) -> None:
        """Destroy the node and its actions. rclpy alone would keep the actions, and the middleware could not end."""
        for action in [one for one in self.waitables if isinstance(one, (ActionClient, ActionServer))]:
            action.destroy()
        super().destroy_node()

    def clock_problem(self, timeout: float = _CLOCK_TIMEOUT) -> Reason | None:
        """Return a reason if ROS time is simulated, and has not begun or stands still; else None.

        It stands still if all calls of this method in the last ``timeout`` [s] of real time saw the same ROS time.
        """
        clock: Any = self.get_clock()
        now, wall = self.now, time.monotonic()
        if now != self._ros_time[0]:
            self._ros_time = now, wall
        if not clock.ros_time_is_active:
            return None
        if now == 0.0:
            return Reason(RosReason.NO_CLOCK)
        return Reason(RosReason.CLOCK_STANDS) if wall - self._ros_time[1] >= timeout else None


class ManagedNode(LifecycleNodeMixin, BaseNode):
    """A node with a lifecycle, which starts active. ``ros2 lifecycle set NODE deactivate`` makes it inactive.

    Subclasses override :meth:`begin` and :meth:`end`, which make the node active or inactive, or return why this is not
    possible. A transition is answered when it is complete. Parameters are read at the start only. For this reason
    ``cleanup`` fails.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        BaseNode.__init__(self, name, **kwargs)
        LifecycleNodeMixin.__init__(self)
        self._starting = False
        # The state: unconfigured, inactive, active, finalized, or the transition between inactive and active.
        self.lifecycle_state = "unconfigured"

    def begin(self) -> str | None:
        return None

    def end(self) -> str | None:
        return None

    def start_active(self) -> None:
        """Make the node active, without :meth:`begin`. A subclass calls it at the end of its own start."""
        self._starting = True
        self.trigger_configure()
        self.trigger_activate()
        self._starting, self.lifecycle_state = False, "active"

    @property
    def is_active(self) -> bool:
        return self.lifecycle_state == "active"

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        if self._starting:
            return TransitionCallbackReturn.SUCCESS
        return self._tried("activated", self.begin, "activating", "active")

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._tried("deactivated", self.end, "deactivating", "inactive")

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.get_logger().warning("not cleaned up: parameters are read once, restart the node for others")
        return TransitionCallbackReturn.FAILURE

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.exit_code, self.lifecycle_state = 0, "finalized"
        return TransitionCallbackReturn.SUCCESS

    def _tried(self, what: str, act: Callable[[], str | None], meanwhile: str, done: str) -> TransitionCallbackReturn:
        """Call ``act`` to go to the state ``done``. If it returns a problem, the node keeps its state."""
        before, self.lifecycle_state = self.lifecycle_state, meanwhile
        try:
            problem = act()
        except Exception as error:  # The exception is caught and logged here, because rclpy would hide it.
            problem = f"{type(error).__name__}: {error}"
        self.lifecycle_state = done if problem is None else before
        if problem is None:
            self.get_logger().info(what)
            return TransitionCallbackReturn.SUCCESS
        self.get_logger().warning(f"not {what}: {problem}")
        return TransitionCallbackReturn.FAILURE


def run_node(*makes: Callable[[], BaseNode]) -> int:
    """Run the main function of an executable: make the nodes, spin until Ctrl-C or SIGTERM, and close them.

    Several nodes share the process and its thread. If one node ends, all nodes end. A wrong configuration gives one
    line on stderr and exit code 2.

    Returns:
        The exit code.
    """
    name = sys.argv[0].rsplit("/", 1)[-1]
    set_up_middleware(os.environ)
    try:
        rclpy.init(args=list(sys.argv), signal_handler_options=rclpy.SignalHandlerOptions.NO)
    except rclpy_implementation.RCLError as error:  # For example, arguments could not be parsed.
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    stop = StopRequest()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.ask())
    nodes: list[BaseNode] = []
    executor: SingleThreadedExecutor | None = None
    try:
        for make in makes:
            nodes.append(make())
        executor = TickExecutor() if all(node.ticks for node in nodes) else SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        for timer in [timer for node in nodes for timer in node.timers if not timer.is_canceled()]:
            timer.reset()  # Nodes with the same rate then tick together, and the process wakes up only once.
        # Objects that exist now are excluded from garbage collection. To collect all of them takes longer than a tick.
        gc.collect()
        gc.freeze()
        _take_priority(nodes)
        while not stop.asked and all(node.exit_code is None for node in nodes):
            executor.spin_once(timeout_sec=0.1)
    except (Q2R2Error, ParameterException) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except ExternalShutdownException:
        pass
    finally:
        asked = time.monotonic()
        for node in reversed(nodes):
            node.close()
        # No arm waits for this process any more, so the middleware may end slowly: without priority, but within a time
        # limit.
        schedule_thread_as_others()
        global _deadline
        _deadline = max(asked + LONGEST_END, time.monotonic() + _LEAST_END)
        end_in_time()
        if executor is not None:
            # Without this call, Python would destroy the executor's parts in any order. rclpy would print a traceback.
            executor.shutdown()
        for node in reversed(nodes):
            node.destroy_node()
        rclpy.try_shutdown()
        signal.alarm(0)
    return next((node.exit_code for node in nodes if node.exit_code is not None), 0)


def end_in_time() -> None:
    """Let SIGALRM end this process ``LONGEST_END`` after it was asked to end, including the time to close its nodes."""
    signal.setitimer(signal.ITIMER_REAL, max(min(_deadline - time.monotonic(), LONGEST_END), 1e-3))


def _take_priority(nodes: Sequence[BaseNode]) -> None:
    """Take a real-time priority before the nodes tick. Slow work, such as compiling, is done before that."""
    priority = max(node.priority for node in nodes)
    if not priority:
        return
    log = nodes[0].get_logger()
    if problem := schedule_thread_first(priority):
        log.info(f"real time: {problem}")
        return
    # The import is here, because not every system has this module. Linux has it, and only there can a process have a
    # real-time priority.
    import resource

    def give_up(*_: object) -> None:
        schedule_thread_as_others()
        log.warning(f"real time: given up, ticks left no time to sleep for {_NEVER_IDLE:g} s; allowed: a lower rate")

    signal.signal(signal.SIGXCPU, give_up)
    resource.setrlimit(resource.RLIMIT_RTTIME, (int(1e6 * _NEVER_IDLE), resource.getrlimit(resource.RLIMIT_RTTIME)[1]))
