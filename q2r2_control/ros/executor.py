"""An executor for nodes that tick: at each tick it takes what has arrived, and then lets the timers work with it.

rclpy's own executor wakes for each message, and for each callback it collects all entities, builds a wait set and
makes a task, twice. In a node that ticks that takes much processor time, for messages that wait for the next tick
anyway. A wait set takes as long as all the rest of an idle tick, even one that is kept: this one sleeps until the
next tick.
"""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import compress
from typing import Any, NamedTuple

from rclpy.clock import ROSClock
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Task

# Between two looks at what does not wait for a tick: services, clients, actions, and topics that are latched or have no
# publisher; services of parameters; events, and which topics have publishers [s].
_CALLS_PERIOD, _PARAMETERS_PERIOD, _EVENTS_PERIOD = 0.02, 0.1, 0.5
# Every node has these services.
_PARAMETERS = (
    "/describe_parameters",
    "/get_parameters",
    "/get_parameter_types",
    "/list_parameters",
    "/set_parameters",
    "/set_parameters_atomically",
    "/get_type_description",
)
_LONG = 10**18  # [ns]
# Timers of one rate that are due so soon after one another are waited for together [ns].
_TOGETHER = 200_000
_MOST_MESSAGES = 100  # of one subscription between two ticks
# What nodes have, and its name in wait sets, in the order of a wait set's sizes.
_KINDS = {
    "subscription": "subscription",
    "guard": "guard_condition",
    "timer": "timer",
    "client": "client",
    "service": "service",
    "event": "event",
}


class TickExecutor(SingleThreadedExecutor):
    """Waits for timers only, and takes all messages before it runs them.

    Services, clients, actions, and what other threads ask for, are looked at fifty times a second; services of
    parameters ten times; events, which tell of settings that do not match, twice a second. They are rclpy's executor to
    run, as callbacks are that are coroutines. Topics that are latched, or had no publisher within the last half second,
    are looked at fifty times a second as well; the first message makes the latter ones like all others.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._outdated = True
        self._held = ExitStack()  # an entity that is destroyed lives until it is no longer looked at
        self._waiting = False  # a coroutine
        self._slept = time.monotonic()
        self._streams: list[_Subscription] = []  # looked at in each tick
        self._quiet: list[_Subscription] = []  # and with services
        self._heard = self._sorted = -math.inf  # when the quiet ones were looked at, and when sorted out [s]
        self._timers: list[Any] = []
        self._periods: list[int] = []  # [ns]
        self._ros_clocks: list[ROSClock] = []  # of the timers
        self._ticks = _KeptWaitSet({}, (), self._context)
        self._others: dict[float, _KeptWaitSet] = {}  # by the time between two looks at them [s]
        self._looked: dict[float, float] = {}  # by the same, when they were looked at [s]

    def add_node(self, node: Node) -> bool:
        """See :class:`rclpy.executors.Executor`."""
        self._outdated = True
        return bool(super().add_node(node))

    def remove_node(self, node: Node) -> None:
        """See :class:`rclpy.executors.Executor`."""
        self._outdated = True
        super().remove_node(node)

    def wake(self) -> None:
        """Entities were made or destroyed, or a future is done."""
        self._outdated = True
        super().wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """See :class:`rclpy.executors.Executor`."""
        self._held.close()
        return bool(super().shutdown(timeout_sec))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for at most ``timeout_sec`` or 20 ms for a timer; then run what is ready."""
        if self._outdated:
            if not self._context.ok():
                raise ExternalShutdownException
            self._outdated = False
            self._collect()
            self._run_others()
        unlimited = timeout_sec is None or timeout_sec < 0.0
        ready, others = self._wait(_CALLS_PERIOD if unlimited else min(timeout_sec or 0.0, _CALLS_PERIOD))
        if not self._context.ok():
            raise ExternalShutdownException
        for one in self._streams:
            self._take(one)
        now = time.monotonic()
        if now - self._heard >= _CALLS_PERIOD:
            self._heard = now
            self._take_quiet(now)
        for timer in ready:
            if self._outdated:
                if timer.handle.is_timer_ready():  # not cancelled meanwhile
                    _call(self._take_timer(timer))
            elif (handle := timer.handle).is_timer_ready():
                handle.call_timer()
                timer.callback()
        # What was destroyed just now is not to be waited for; the next call collects the entities and runs the others.
        if not self._outdated and (others or self._something_else_is_ready()):
            self._run_others()

    @property
    def awake(self) -> float:
        """Time without sleep [s]: how long ticks have come later than they were due."""
        return time.monotonic() - self._slept

    def take_messages(self) -> None:
        """Run the callbacks of all messages that have arrived; also for a callback that ticks by itself for a while."""
        for one in (*self._streams, *self._quiet):
            self._take(one)

    def _take(self, one: _Subscription) -> bool:
        """Run the callbacks of all messages that have arrived on a topic; whether there were any.

        Where nothing was destroyed since the entities were collected, rclpy's way would cost more than the message.
        """
        subscription, take, arguments = one.entity, one.take, one.arguments
        for number in range(_MOST_MESSAGES):
            if self._outdated:
                if (taken := self._take_subscription(subscription)) is None:
                    return number > 0
                _call(taken)
            elif (message := take(subscription.msg_type, subscription.raw)) is None:
                return number > 0
            else:
                subscription.callback(*message[:arguments])
        return True

    def _take_quiet(self, now: float) -> None:
        """Look at topics that seldom bring something; now and then also which these are.

        To look takes a third as long as to take a message, and what has no publisher brings none.
        """
        woken = [one for one in self._quiet if self._take(one) and not one.latched]
        if self._outdated:
            return  # the lists are made anew
        if woken:
            self._streams += woken
            self._quiet = [one for one in self._quiet if one not in woken]
        if now - self._sorted >= _EVENTS_PERIOD:
            self._sorted = now
            every = (*self._streams, *self._quiet)
            self._quiet = [one for one in every if one.latched or not one.entity.handle.get_publisher_count()]
            self._streams = [one for one in every if one not in self._quiet]

    def _wait(self, timeout: float) -> tuple[list[Any], bool]:
        """Wait for at most ``timeout`` [s]; returns the timers that may be ready, and whether something else is."""
        if any(clock.ros_time_is_active for clock in self._ros_clocks):
            return self._ticks.wait(timeout)  # which notices that simulated time has moved on
        # Until the next tick, and not until each slower timer: those that come due in between run with it.
        left = [timer.handle.time_until_next_call() for timer in self._timers]  # [ns]; None: cancelled
        tick = min((p for p, one in zip(self._periods, left, strict=True) if one is not None), default=0)
        until = [one for p, one in zip(self._periods, left, strict=True) if one is not None and p == tick]
        together = min(until, default=_LONG) + _TOGETHER
        longest = min(int(timeout * 1e9), max((one for one in until if one <= together), default=_LONG))
        if longest > 0:
            time.sleep(longest * 1e-9)
            self._slept = time.monotonic()
        due = [one is not None and one <= longest for one in left]
        return list(compress(self._timers, due)), False

    def _something_else_is_ready(self) -> bool:
        now, ready = time.monotonic(), False
        for period, wait_set in self._others.items():
            if now - self._looked.get(period, -math.inf) >= period:
                self._looked[period] = now
                timers, others = wait_set.wait(0.0)
                ready = ready or others or bool(timers) or self._waiting
        return ready

    def _run_others(self) -> None:
        """Let rclpy's executor run all that is ready, and go on with coroutines that wait for something."""
        waiting: set[Task] = set()
        more = True
        while more:
            with suppress(TimeoutException):
                while (task := self.wait_for_ready_callbacks(timeout_sec=0.0)[0]) not in waiting:
                    task()
                    if task.done():
                        task.result()  # raises what the callback has raised
                    else:
                        waiting.add(task)
            # A callback may have made tasks: the guard condition that told of them has been taken with it.
            with self._tasks_lock:
                more = any(not task.done() and task not in waiting for task, *_ in self._tasks)
        self._waiting = bool(waiting)

    def _collect(self) -> None:
        """Note the entities of now."""
        self._held.close()
        nodes = self.get_nodes()
        found = {kind: [one for node in nodes for one in getattr(node, f"{kind}s")] for kind in list(_KINDS)[:-1]}
        for one in (one for some in found.values() for one in some):
            self._held.enter_context(one.handle)
        waitables = [one for node in nodes for one in node.waitables]
        for waitable in waitables:
            self._held.enter_context(waitable)
        events = [one for one in waitables if isinstance(one, EventHandler)]
        actions = [one for one in waitables if not isinstance(one, EventHandler)]
        self._streams = [_Subscription.of(one) for one in found["subscription"] if _is_plain(one)]
        self._quiet = []
        coroutines = {kind: [one for one in found[kind] if not _is_plain(one)] for kind in ("subscription", "timer")}
        self._timers = timers = [one for one in found["timer"] if _is_plain(one)]
        self._periods = [int(one.timer_period_ns) for one in timers]
        clocks = {id(one.clock): one.clock for one in timers}
        self._ros_clocks = [clock for clock in clocks.values() if isinstance(clock, ROSClock)]
        own = [self._guard, self._sigint_gc]
        parameters = [one for one in found["service"] if one.srv_name.endswith(_PARAMETERS)]
        services = [one for one in found["service"] if one not in parameters]
        calls = coroutines | {"client": found["client"], "service": services, "guard": found["guard"] + own}
        self._ticks = _KeptWaitSet({"timer": timers, "guard": own}, (), self._context)
        self._others = {
            _CALLS_PERIOD: _KeptWaitSet(calls, actions, self._context),
            _PARAMETERS_PERIOD: _KeptWaitSet({"service": parameters}, (), self._context),
            _EVENTS_PERIOD: _KeptWaitSet({}, events, self._context),
        }


class _Subscription(NamedTuple):
    """One subscription whose callback is a plain function."""

    entity: Any
    take: Callable[..., Any]  # a message and its information, or None
    arguments: int  # how many of these two the callback gets
    latched: bool  # holds what seldom changes

    @classmethod
    def of(cls, entity: Any) -> _Subscription:
        alone = entity._callback_type is Subscription.CallbackType.MessageOnly
        latched = entity.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
        return cls(entity, entity.handle.take_message, 1 if alone else 2, latched)


class _KeptWaitSet:
    """Entities by kind, and waitables, and the wait set that they are in."""

    def __init__(self, entities: Mapping[str, Sequence[Any]], waitables: Sequence[Any], context: Any) -> None:
        self._waitables = waitables
        self._kinds = [
            (_KINDS[kind], {one.handle.pointer: one for one in some}, [one.handle for one in some])
            for kind, some in entities.items()
            if some
        ]
        counts = [waitable.get_num_entities() for waitable in waitables]
        sizes = [
            len(entities.get(kind, ())) + sum(getattr(count, f"num_{name}s") for count in counts)
            for kind, name in _KINDS.items()
        ]
        with context.handle:
            self._wait_set: Any = rclpy_implementation.WaitSet(*sizes, context.handle)

    def wait(self, timeout: float) -> tuple[list[Any], bool]:
        """Wait for at most ``timeout`` [s]; returns the timers that are ready, and whether something else is."""
        if not self._kinds and not self._waitables:
            return [], False  # rcl takes it for a mistake
        wait_set = self._wait_set
        wait_set.clear_entities()
        for name, _, handles in self._kinds:
            add = getattr(wait_set, f"add_{name}")
            for handle in handles:
                add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(int(timeout * 1e9))
        timers: list[Any] = []
        others = False
        for name, entities, _ in self._kinds:
            ready = [entities[pointer] for pointer in wait_set.get_ready_entities(name) if pointer in entities]
            if name == "timer":
                timers = ready
                continue
            others = others or bool(ready)
            if name == "guard_condition":
                for guard in ready:
                    guard._executor_triggered = True  # waiting has reset it; rclpy's executor triggers it again
        return timers, others or any(one.is_ready(wait_set) for one in self._waitables)


def _call(taken: Any) -> None:
    """Run what rclpy has taken: a coroutine, which never waits where the callback is a plain function."""
    if taken is not None:
        with suppress(StopIteration):
            taken().send(None)


def _is_plain(entity: Any) -> bool:
    return not inspect.iscoroutinefunction(entity.callback)
