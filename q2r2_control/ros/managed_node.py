"""Nodes with the states of a ROS 2 lifecycle: ``ros2 lifecycle set /cartesian_controller deactivate``.

They are configured by their parameters and active when they start, as nodes without a lifecycle are. A transition is
answered when it is done: whoever deactivates a controller and then starts another one waits for the answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from q2r2_control.ros.base_node import BaseNode

_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_ACTIVE = "active"


class ManagedNode(LifecycleNodeMixin, BaseNode):
    """Subclasses override :meth:`begin` and :meth:`end`, and call :meth:`start_active` at the end of their own start.

    What is read at the start is not read again, so ``cleanup`` fails: another configuration is another process.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        BaseNode.__init__(self, name, **kwargs)
        LifecycleNodeMixin.__init__(self)
        self._starting = False
        self.ticked, self._counted_at = 0, time.monotonic()  # since the rate was last asked for, and when [s]

    def tick_rate(self) -> float:
        """Ticks in a second since this was last asked for [Hz]."""
        now = time.monotonic()
        rate = self.ticked / max(now - self._counted_at, 1e-9)
        self.ticked, self._counted_at = 0, now
        return round(rate, 1)

    def begin(self) -> str | None:
        """Become active; returns why that is not possible now, or None."""
        return None

    def end(self) -> str | None:
        """Become inactive; returns why that is not possible now, or None."""
        return None

    def start_active(self) -> None:
        """Configured and active from the start, without :meth:`begin`."""
        self._starting = True
        self.trigger_configure()
        self.trigger_activate()
        self._starting = False

    @property
    def lifecycle_state(self) -> str:
        """unconfigured, inactive, active, finalized, or the transition between them."""
        return str(self._state_machine.current_state[1])

    @property
    def is_active(self) -> bool:
        return self.lifecycle_state == _ACTIVE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See rclpy's LifecycleNode."""
        return _SUCCESS if self._starting else self._tried("activated", self.begin)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See rclpy's LifecycleNode."""
        return self._tried("deactivated", self.end)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See rclpy's LifecycleNode."""
        self.get_logger().warning("not cleaned up: parameters are read once, restart the node for others")
        return _FAILURE

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """See rclpy's LifecycleNode; the process ends."""
        self.exit_code = 0
        return _SUCCESS

    def _tried(self, what: str, act: Callable[[], str | None]) -> TransitionCallbackReturn:
        try:
            problem = act()
        except Exception as error:  # rclpy would swallow it
            problem = f"{type(error).__name__}: {error}"
        if problem is None:
            self.get_logger().info(what)
            return _SUCCESS
        self.get_logger().warning(f"not {what}: {problem}")
        return _FAILURE
