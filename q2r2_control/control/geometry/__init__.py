"""Where joints, bodies and tools are, and how far bodies are apart: kernels over a robot's joint tree and its shapes.

``kinematics`` places joint frames; ``collision`` holds the bodies and monitored pairs and places them;
``closest_points`` knows segments and boxes; ``pair_distance`` measures pairs and gives their gradients;
``smooth_distance`` does so with a gradient that never jumps. Nothing of the other rooms is imported here.
"""

from q2r2_control.control.geometry.collision import (
    CollisionData,
    CollisionModel,
    collision_model_of,
    update_placements,
)
from q2r2_control.control.geometry.kinematics import Chain, Placements, chain_of, place
from q2r2_control.control.geometry.pair_distance import at_least, distance_row, measure, measure_part
from q2r2_control.control.geometry.smooth_distance import measure_smooth

__all__ = [
    "Chain",
    "CollisionData",
    "CollisionModel",
    "Placements",
    "at_least",
    "chain_of",
    "collision_model_of",
    "distance_row",
    "measure",
    "measure_part",
    "measure_smooth",
    "place",
    "update_placements",
]
