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
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import compress
from typing import Any

from rclpy.clock import ROSClock
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.task import Task

# Between two looks at what does not wait for a tick: services, clients and actions; services of parameters; events [s].
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
    run, as callbacks are that are coroutines.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._outdated = True
        self._held = ExitStack()  # an entity that is destroyed lives until it is no longer looked at
        self._waiting = False  # a coroutine
        self._subscriptions: list[Any] = []
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
        if not self._context.ok():
            raise ExternalShutdownException
        if self._outdated:
            self._outdated = False
            self._collect()
            self._run_others()
        unlimited = timeout_sec is None or timeout_sec < 0.0
        ready, others = self._wait(_CALLS_PERIOD if unlimited else min(timeout_sec or 0.0, _CALLS_PERIOD))
        if not self._context.ok():
            raise ExternalShutdownException
        self.take_messages()
        for timer in ready:
            if timer.handle.is_timer_ready():  # not cancelled meanwhile
                _call(self._take_timer(timer))
        if others or self._something_else_is_ready():
            self._run_others()

    def take_messages(self) -> None:
        """Run the callbacks of all messages that have arrived; also for a callback that ticks by itself for a while."""
        for subscription in self._subscriptions:
            for _ in range(_MOST_MESSAGES):
                if (taken := self._take_subscription(subscription)) is None:
                    break
                _call(taken)

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
        self._subscriptions = [one for one in found["subscription"] if _is_plain(one)]
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
