"""What keeps every limit and every distance, whatever targets and solver do; the argument is in README.md.

``joint_limits`` bounds the next velocities; ``stop_certificate`` proves a step and the stop after it, by
``speed_bound`` with ``velocity_bounds`` or, where distances leave no room for that, ``separating_plane``;
``safety_filter`` takes of a solution what can be certified. ``separation_rows`` are for comfort: they make the solver
ask for little else. Each takes a ``SafetyModel`` (fixed) and ``SafetyData`` (the reference's state, and what is
rewritten at each tick).
"""

from q2r2_control.control.safety.joint_limits import JointLimits, VelocityBox, next_velocity_box
from q2r2_control.control.safety.safety_data import ReferenceState, SafetyData
from q2r2_control.control.safety.safety_filter import apply_safety_filter, certify_start
from q2r2_control.control.safety.safety_model import Approach, SafetyModel
from q2r2_control.control.safety.separating_plane import stays_beyond
from q2r2_control.control.safety.separation_rows import measure_pairs, write_separation_rows
from q2r2_control.control.safety.stop_certificate import certify
from q2r2_control.control.safety.stop_shapes import brake, write_stop
from q2r2_control.control.safety.velocity_bounds import BodyVelocities, fastest_approach, update_body_velocities

__all__ = [
    "Approach",
    "BodyVelocities",
    "JointLimits",
    "ReferenceState",
    "SafetyData",
    "SafetyModel",
    "VelocityBox",
    "apply_safety_filter",
    "brake",
    "certify",
    "certify_start",
    "fastest_approach",
    "measure_pairs",
    "next_velocity_box",
    "stays_beyond",
    "update_body_velocities",
    "write_separation_rows",
    "write_stop",
]
