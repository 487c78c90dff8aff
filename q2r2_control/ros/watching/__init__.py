"""Watching a set of nodes from outside, for ``q2r2 ros watch`` and ``q2r2 ros doctor``: nothing here takes part in it.

``set_view`` says what is known of a set, and why an arm does not move; ``set_listener`` finds that out in the running
domain; ``findings`` says what is wrong with it, and ``environment`` what of ROS is missing here. They are imported when
first used; only ``set_listener`` needs rclpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.ros.watching.environment import examine_environment
    from q2r2_control.ros.watching.findings import Finding, examine_set
    from q2r2_control.ros.watching.set_listener import WatchError, watch_set
    from q2r2_control.ros.watching.set_view import SetView

__all__ = ["Finding", "SetView", "WatchError", "examine_environment", "examine_set", "watch_set"]

__getattr__ = lazy_exports(
    __name__,
    {
        "Finding": "findings",
        "SetView": "set_view",
        "WatchError": "set_listener",
        "examine_environment": "environment",
        "examine_set": "findings",
        "watch_set": "set_listener",
    },
)
