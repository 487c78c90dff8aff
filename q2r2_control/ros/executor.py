"""An executor for nodes that tick: it sleeps until a tick, takes the messages that have arrived, and runs the tick.

Messages and ticks go past rclpy's wait set; all else, such as services, is rclpy's to run. Measured on two busy cores
with both arms moving: 1.1 cores and 167 joint commands a second. With ``SingleThreadedExecutor`` it was 1.7 cores and
53. The ``EventsExecutor`` of rclpy 7.1 fails with a ``SystemError`` where a callback gets a message's times.
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

_SERVED = 0.05  # period of services, slow timers, silent topics and all else that is no tick and no stream [s]
_MOST_CALLS = 20  # of these at once: a coroutine that waits for something is ready all the time
_MOST_MESSAGES = 100  # of one subscription between two ticks
_SIMULATED = 0.001  # period of looking at a simulated clock [s]


class TickGroup(MutuallyExclusiveCallbackGroup):
    """A node's ticks and the messages that they use. Executors other than :class:`TickExecutor` run it as any group."""

    is_taken = False  # by a TickExecutor

    def can_execute(self, entity: Any) -> bool:
        return not self.is_taken and bool(super().can_execute(entity))


class TickExecutor(SingleThreadedExecutor):
    """Runs each node's ``tick_group`` itself; rclpy runs all other callbacks, for which it looks each 50 ms."""

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._changed = True  # entities were made or destroyed
        self._subscriptions: list[Any] = []  # and how many arguments the callback of each gets
        self._streams: list[Any] = []  # those with a publisher; to look for a message takes long where none can come
        self._ticks: list[Any] = []  # timers
        self._served_at = -math.inf  # [s]

    def add_node(self, node: Any) -> bool:
        node.tick_group.is_taken = self._changed = True
        return bool(super().add_node(node))

    def wake(self) -> None:
        self._changed = True
        super().wake()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Sleep until a tick is due, for 50 ms or ``timeout_sec`` at most; run what is due then."""
        if self._changed:
            self._collect()
        longest = _SERVED if timeout_sec is None or timeout_sec < 0.0 else min(timeout_sec, _SERVED)
        if (sleep := self._time_left(longest)) > 0.0:
            time.sleep(sleep)
        if not self.context.ok():
            raise ExternalShutdownException
        self.take_messages()
        for timer in self._ticks:
            if self._changed:
                break
            if timer.is_ready():
                timer.handle.call_timer()
                timer.callback()
        if (now := time.monotonic()) - self._served_at >= _SERVED:
            self._served_at, self._streams = now, self._subscriptions
            self.take_messages()  # a publisher may have come, and even gone
            if not self._changed:
                self._streams = [one for one in self._streams if one[0].handle.get_publisher_count()]
            self._serve()

    def take_messages(self) -> None:
        """Run the callbacks of all messages that have arrived; also for a service that ticks by itself for a while."""
        if self._changed:
            self._collect()
        for one, arguments in self._streams:
            for _ in range(_MOST_MESSAGES):
                if self._changed:
                    return  # this subscription may be destroyed
                if (taken := one.handle.take_message(one.msg_type, one.raw)) is None:
                    break
                one.callback(*taken[:arguments])

    def _time_left(self, longest: float) -> float:
        if any(isinstance(timer.clock, ROSClock) and timer.clock.ros_time_is_active for timer in self._ticks):
            return min(longest, _SIMULATED)
        left = [timer.time_until_next_call() for timer in self._ticks]  # [ns]; None: cancelled
        return min([longest, *(1e-9 * one for one in left if one is not None)])

    def _serve(self) -> None:
        with suppress(TimeoutException):
            for _ in range(_MOST_CALLS):
                task, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
                task()
                if task.done():
                    task.result()  # raises what the callback has raised

    def _collect(self) -> None:
        self._changed = False
        nodes: list[Any] = list(self.get_nodes())
        groups = [(node, node.tick_group) for node in nodes]
        self._ticks = [one for node, group in groups for one in node.timers if one.callback_group is group]
        streams = [one for node, group in groups for one in node.subscriptions if one.callback_group is group]
        self._streams = self._subscriptions = [(one, _arguments(one.callback)) for one in streams]


def _arguments(callback: Callable[..., None]) -> int:
    try:
        inspect.signature(callback).bind(None)
    except TypeError:
        return 2
    return 1
