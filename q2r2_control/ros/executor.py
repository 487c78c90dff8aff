"""An executor for nodes that tick: it sleeps until a tick, takes the messages that have arrived, and runs the tick.

Messages and timers bypass rclpy's wait set. rclpy runs everything else, such as services. On two cores that nothing
else uses, the nodes of a simulated cell with both arms moving need 0.98 cores for 250 joint commands per second. With
``SingleThreadedExecutor``, on two busy cores, they needed 1.7 cores and sent only 53 joint commands per second. The
``EventsExecutor`` of rclpy 7.1 fails with a ``SystemError`` if a callback gets the times of a message.

rclpy makes a wait set each time that it looks for work. This takes a millisecond while other programs occupy the
caches. A permanent wait set tells within 0.05 ms whether there is anything to run.
"""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import ROSClock
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation

_SERVED = 0.05  # Period for services, slow timers and silent topics, which are neither ticks nor streams [s].
# Greatest number of callbacks that rclpy runs in a row. A coroutine that waits is always ready, and would run for ever.
_MOST_CALLS = 20
_MOST_MESSAGES = 100  # Greatest number of messages of one subscription between two ticks.
_SIMULATED = 0.001  # Period for looking at a simulated clock [s].


class TickGroup(MutuallyExclusiveCallbackGroup):
    """The ticks of a node and the messages that they use. Other executors run it like any callback group."""

    is_taken = False  # Whether a TickExecutor runs this group.

    def can_execute(self, entity: Any) -> bool:
        return not self.is_taken and bool(super().can_execute(entity))


class TickExecutor(SingleThreadedExecutor):
    """Runs the ``tick_group`` of each node itself, and all timers. rclpy runs all other callbacks every 50 ms."""

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._changed = True  # Whether timers, subscriptions or the like were made or destroyed.
        self._subscriptions: list[Any] = []  # Subscriptions, each with the number of arguments of its callback.
        self._streams: list[Any] = []  # The subscriptions that have a publisher. Other subscriptions need no check.
        self._ticks: list[Any] = []  # The timers of ticks.
        self._slow_timers: list[Any] = []  # All other timers, except those with a coroutine, which rclpy has to run.
        self._served_at = -math.inf  # Time of the last look at services, slow timers and silent topics [s].
        self._simulated = False  # Whether a tick uses simulated time.
        self._rest = _RestOfNodes([], [])

    def add_node(self, node: Any) -> bool:
        node.tick_group.is_taken = self._changed = True
        return bool(super().add_node(node))

    def wake(self) -> None:
        self._changed = True
        super().wake()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Sleep until a tick is due, for 50 ms or ``timeout_sec`` [s] at most, and run the callbacks that are due."""
        if not self.context.ok():
            raise ExternalShutdownException
        if self._changed:
            self._collect()
        longest = _SERVED if timeout_sec is None or timeout_sec < 0.0 else min(timeout_sec, _SERVED)
        if (sleep := self._time_left(longest)) > 0.0:
            time.sleep(sleep)
        self.take_messages()
        self._run_timers(self._ticks)
        if (now := time.monotonic()) - self._served_at >= _SERVED:
            self._served_at, self._streams, self._simulated = now, self._subscriptions, self._is_simulated()
            self.take_messages()  # This also takes messages of a publisher that has come and gone meanwhile.
            if not self._changed:
                self._streams = [one for one in self._streams if one[0].handle.get_publisher_count()]
            self._run_timers(self._slow_timers)
            if self._changed or self._tasks or self._rest.is_ready():
                self._serve()

    def take_messages(self) -> None:
        """Run the callbacks of all messages that have arrived. A service that runs ticks itself also calls this."""
        if self._changed:
            self._collect()
        for one, arguments in self._streams:
            for _ in range(_MOST_MESSAGES):
                if self._changed:
                    return  # The list is out of date, and this subscription may have been destroyed.
                if (taken := one.handle.take_message(one.msg_type, one.raw)) is None:
                    break
                one.callback(*taken[:arguments])

    def _run_timers(self, timers: list[Any]) -> None:
        for timer in timers:
            if self._changed:
                return  # The list is out of date, and this timer may have been destroyed.
            if timer.is_ready():
                timer.handle.call_timer()
                timer.callback()

    def _time_left(self, longest: float) -> float:
        if self._simulated:
            return min(longest, _SIMULATED)
        left = [timer.time_until_next_call() for timer in self._ticks]  # [ns]; None for a timer that was cancelled.
        return min([longest, *(1e-9 * one for one in left if one is not None)])

    def _is_simulated(self) -> bool:
        """Return whether a tick uses simulated time. This can change while a node runs."""
        return any(isinstance(timer.clock, ROSClock) and timer.clock.ros_time_is_active for timer in self._ticks)

    def _serve(self) -> None:
        with suppress(TimeoutException):
            for _ in range(_MOST_CALLS):
                task, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
                task()
                if task.done():
                    task.result()  # This raises the exception of the callback.

    def _collect(self) -> None:
        self._changed = False
        nodes: list[Any] = list(self.get_nodes())
        groups = [(node, node.tick_group) for node in nodes]
        self._ticks = [one for node, group in groups for one in node.timers if one.callback_group is group]
        others = [one for node, group in groups for one in node.timers if one.callback_group is not group]
        self._slow_timers = [one for one in others if not inspect.iscoroutinefunction(one.callback)]
        streams = [one for node, group in groups for one in node.subscriptions if one.callback_group is group]
        self._streams = self._subscriptions = [(one, _arguments(one.callback)) for one in streams]
        self._rest, self._simulated = _RestOfNodes(nodes, self._slow_timers), self._is_simulated()


class _RestOfNodes:
    """The callbacks of nodes that belong to no :class:`TickGroup`. rclpy executes them."""

    def __init__(self, nodes: list[Any], without: list[Any]) -> None:
        """Leave out the timers ``without``, which the executor runs itself."""
        groups = [node.tick_group for node in nodes]

        def others(kind: str) -> list[Any]:
            found = (one for node in nodes for one in getattr(node, kind))
            return [one for one in found if one.callback_group not in groups]

        self._subscriptions = others("subscriptions")
        self._timers = [one for one in others("timers") if one not in without]
        self._clients, self._services, self._waitables = others("clients"), others("services"), others("waitables")
        # Guard conditions are not waited for, because a wait would clear their trigger, and rclpy would not see it.
        self._has_guards = any(list(node.guards) for node in nodes)
        self._wait_set: Any = None
        if nodes:
            counts = [len(self._subscriptions), 0, len(self._timers), len(self._clients), len(self._services), 0]
            for one in self._waitables:
                its = one.get_num_entities()
                own = [its.num_subscriptions, its.num_guard_conditions, its.num_timers, its.num_clients]
                own += [its.num_services, its.num_events]
                counts = [count + more for count, more in zip(counts, own, strict=True)]
            self._wait_set = rclpy_implementation.WaitSet(*counts, nodes[0].context.handle)

    def is_ready(self) -> bool:
        """Return whether one of these callbacks can run now."""
        wait_set = self._wait_set
        if self._has_guards or wait_set is None:
            return True
        wait_set.clear_entities()
        for one in self._subscriptions:
            wait_set.add_subscription(one.handle)
        for one in self._timers:
            wait_set.add_timer(one.handle)
        for one in self._clients:
            wait_set.add_client(one.handle)
        for one in self._services:
            wait_set.add_service(one.handle)
        for one in self._waitables:
            one.add_to_wait_set(wait_set)
        wait_set.wait(0)
        kinds = "subscription", "timer", "client", "service"
        return any(map(wait_set.get_ready_entities, kinds)) or any(one.is_ready(wait_set) for one in self._waitables)


def _arguments(callback: Callable[..., None]) -> int:
    try:
        inspect.signature(callback).bind(None)
    except TypeError:
        return 2
    return 1
