"""What moves. To add a plant, implement ``Plant`` of ``base``, which also checks commands.

``factory`` makes a plant by name. ``kinematic`` follows commands exactly. ``mujoco`` simulates the
cell: ``mujoco_model``, ``mujoco_obstacles`` and ``scene`` build it, ``servo`` drives its joints, ``mujoco_view`` shows
it, and ``mujoco_cameras`` takes the pictures of its own cameras. ``follower`` and ``simulated_cell`` run it from
commands that come at any time, as from ROS. MuJoCo is imported only where it is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.plants.base import Plant
    from q2r2_control.plants.factory import check_mode, make_plant
    from q2r2_control.plants.kinematic import KinematicPlant
    from q2r2_control.plants.mujoco import MujocoPlant
    from q2r2_control.plants.simulated_cell import SimulatedCell

__all__ = [
    "KinematicPlant",
    "MujocoPlant",
    "Plant",
    "SimulatedCell",
    "check_mode",
    "make_plant",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "KinematicPlant": "kinematic",
        "MujocoPlant": "mujoco",
        "Plant": "base",
        "SimulatedCell": "simulated_cell",
        "check_mode": "factory",
        "make_plant": "factory",
    },
)
