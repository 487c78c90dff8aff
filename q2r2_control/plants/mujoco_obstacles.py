"""How obstacles of the cell feel in MuJoCo, above all to a finger that slides over them.

**Sliding.** MuJoCo solves for normal force and friction in one convex problem. There a contact that slides at the
speed v presses as one that is deeper by about mu v T_n^2 / T_f, with the time constants T_n of the normal direction
and T_f of friction (``solreffriction``). So a finger rises as it gets faster; where it has risen by all of its depth,
contact is lost and found again without end. By default T_f is T_n, 20 ms: a finger that 20 N press 0.7 mm deep
chattered at 0.1 m/s with a friction of 0.6, in every direction, where Coulomb's friction leaves it quiet. A longer
T_f keeps the normal force apart from the speed. What holds creeps more by it, which a larger ``impratio`` makes up
for. Only contacts that are named pair by pair have a T_f of their own, so those of fingers and obstacles are.
"""

from __future__ import annotations

import mujoco

from q2r2_control.config.cell import Config

# Of contacts, of which the larger one's properties count: gripper pads before all else, and obstacles before pads.
PAD_PRIORITY, _OBSTACLE_PRIORITY = 1, 2

# Torsion [m] and rolling [m] of a contact of about a square centimetre.
TORSION, ROLLING = 0.02, 0.001

# T_n [s], MuJoCo's usual one, and damping ratio: the pads' would make a table of millions of N/m of it, with the
# inertia of a whole arm behind them.
_STIFFNESS = (0.02, 1.0)

# T_f [s]; a damping ratio has no effect on friction.
_SLIDING = (0.1, 1.0)

# Stiffness of friction against that of the normal direction: holds what is grasped, and a finger on an obstacle.
FRICTION_IMPEDANCE = 100.0


def set_obstacles(spec: mujoco.MjSpec, config: Config) -> None:
    """Contacts of what stands in the cell; they count before those of the pads."""
    for name in config.obstacles:
        for geom in spec.body(name).geoms:
            geom.condim, geom.friction = 4, (config.mujoco.obstacle_friction, TORSION, ROLLING)
            geom.solref, geom.priority = _STIFFNESS, _OBSTACLE_PRIORITY


def let_fingers_slide(spec: mujoco.MjSpec, config: Config) -> None:
    """Name the pairs of pads and obstacles that can touch, with friction that leaves the normal force alone."""
    pads = [geom for body in spec.bodies for geom in body.geoms if geom.priority == PAD_PRIORITY and geom.contype]
    friction = config.mujoco.obstacle_friction
    for name in config.obstacles:
        for geom in (geom for geom in spec.body(name).geoms if geom.contype):
            for pad in pads:
                finger = pad.parent.name
                if any(spec.exclude("|".join(pair)) is not None for pair in ((finger, name), (name, finger))):
                    continue
                pair = spec.add_pair(geomname1=_named(pad), geomname2=_named(geom))
                pair.condim, pair.friction = 4, (friction, friction, TORSION, ROLLING, ROLLING)
                pair.solref, pair.solreffriction = _STIFFNESS, _SLIDING


def _named(geom: mujoco.MjsGeom) -> str:
    """The name of a shape, which gets one where it has none."""
    if not geom.name:
        shapes = list(geom.parent.geoms)
        geom.name = f"{geom.parent.name}_shape_{next(i for i, shape in enumerate(shapes) if shape == geom)}"
    return str(geom.name)
