"""What happens before a node runs; nothing here needs rclpy.

``processes`` says which nodes a cell needs and runs them together (``q2r2 ros up``, ``launch/teleop.launch.py``);
``executables`` starts one of them; ``middleware`` sets up Fast DDS; ``build`` builds the message packages of
``ros/interfaces``. They are imported when first used: every node needs ``middleware``, and no node needs the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.ros.launch.build import BuildError, build_interfaces
    from q2r2_control.ros.launch.middleware import set_up_middleware
    from q2r2_control.ros.launch.processes import NodeProcess, UpError, nodes_of, run_together

__all__ = ["BuildError", "NodeProcess", "UpError", "build_interfaces", "nodes_of", "run_together", "set_up_middleware"]

__getattr__ = lazy_exports(
    __name__,
    {
        "BuildError": "build",
        "NodeProcess": "processes",
        "UpError": "processes",
        "build_interfaces": "build",
        "nodes_of": "processes",
        "run_together": "processes",
        "set_up_middleware": "middleware",
    },
)
