"""The loose parts of a simulated cell.

Processes that only draw must not import this module, because they have to work without the simulator.
"""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.plants.mujoco import MujocoPlant


def places_of_parts(plant: object, config: Config) -> dict[str, int]:
    """Return, for each loose part of a simulated cell by name, the index in MuJoCo's qpos at which its pose begins.

    The result is empty for other plants.
    """
    if not isinstance(plant, MujocoPlant):
        return {}
    return {name: int(plant.model.joint(f"{name}_free").qposadr[0]) for name in config.mujoco.objects}
