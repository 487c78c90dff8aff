"""The loose parts of a simulated cell."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.plants.base import is_mujoco


def places_of_parts(plant: object, config: Config) -> dict[str, int]:
    """Return, for each loose part of a simulated cell by name, the index in MuJoCo's qpos at which its pose begins.

    The result is empty for other plants.
    """
    if not is_mujoco(plant):
        return {}
    return {name: int(plant.model.joint(f"{name}_free").qposadr[0]) for name in config.mujoco.objects}
