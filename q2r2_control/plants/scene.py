"""Floor, sky and light of the simulated cell, and the contacts of obstacles with fingers."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.extras import importing
from q2r2_control.robot.floor import FLOOR

with importing("sim", "the simulation in MuJoCo"):
    import mujoco

# Groups of geoms. MuJoCo's viewers draw the groups 0 to 2. They draw the other groups only on request.
VISUAL_GROUP, COLLISION_GROUP, ENVELOPE_GROUP = 2, 3, 4


def furnish(spec: mujoco.MjSpec, floor: bool) -> None:
    """Add sky, lights and a plane for the floor, and set the view of a window.

    ``floor`` is True if the cell has a floor, whose boxes the plane replaces. Otherwise, the plane is only drawn, at
    z = 0. It then causes no contacts, because the arms are allowed to move below it.
    """
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.90, 0.94, 0.98),
        rgb2=(0.55, 0.66, 0.78),
        width=256,
        height=256 * 6,
    )
    _add_floor(spec, spec.body(FLOOR) if floor else None)
    _add_lights(spec)
    spec.visual.headlight.ambient = (0.25, 0.25, 0.25)
    spec.visual.headlight.diffuse = (0.25, 0.25, 0.25)
    spec.visual.headlight.specular = (0.0, 0.0, 0.0)
    spec.visual.quality.shadowsize = 8192
    spec.visual.quality.offsamples = 8
    # The largest width and height of a picture [pixels], which is sufficient for any camera.
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 3840, 2160
    spec.visual.global_.azimuth, spec.visual.global_.elevation = 145, -20
    spec.stat.center, spec.stat.extent = (0.4, 0.0, 0.4), 1.6


def _add_floor(spec: mujoco.MjSpec, body: mujoco.MjsBody | None) -> None:
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.80, 0.81, 0.82),
        rgb2=(0.77, 0.78, 0.80),
        mark=mujoco.mjtMark.mjMARK_EDGE,
        markrgb=(0.70, 0.71, 0.73),
        width=512,
        height=512,
    )
    material = spec.add_material(name="floor", texrepeat=(1, 1), texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    plane = (body or spec.worldbody).add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.5), material="floor", group=VISUAL_GROUP
    )
    if body is None:
        plane.contype, plane.conaffinity = 0, 0
        return
    for box in body.geoms[:-1]:  # These boxes stand for the plane in the URDF, which has no planes.
        spec.delete(box)


def _add_lights(spec: mujoco.MjSpec) -> None:
    """Add a lamp overhead that casts shadows, and a weak light from the other side that casts no shadows."""
    spec.worldbody.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        pos=(1.6, 1.4, 3.6),
        dir=(-1.2, -1.4, -3.4),
        cutoff=60,
        exponent=2,
        diffuse=(0.65, 0.65, 0.63),
        specular=(0.2, 0.2, 0.2),
        castshadow=True,
    )
    spec.worldbody.add_light(
        name="fill",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(1, -2, 2.5),
        dir=(-0.3, 0.8, -0.7),
        diffuse=(0.2, 0.21, 0.24),
        castshadow=False,
    )


# Priorities of shapes. In a contact, the settings of the shape with the larger priority apply: obstacles come before
# gripper pads, and pads before all other shapes.
PAD_PRIORITY, _OBSTACLE_PRIORITY = 1, 2

# Torsional and rolling friction [m] of a contact of about one square centimetre.
TORSION, ROLLING = 0.02, 0.001

# Time constant of contacts in the normal direction [s], which is MuJoCo's default, and the damping ratio. With the
# values of the pads and the inertia of a whole arm, a table would have a stiffness of millions of N/m.
_STIFFNESS = (0.02, 1.0)

# Time constant of friction [s], and a damping ratio, which has no effect on friction.
_SLIDING = (0.1, 1.0)

# Stiffness of friction relative to the stiffness in the normal direction. With this value, grasped objects do not creep
# out of the fingers, and a finger that rests on an obstacle does not creep over it.
FRICTION_IMPEDANCE = 100.0


def set_obstacles(spec: mujoco.MjSpec, config: Config) -> None:
    """Set the contact settings of obstacles, which have priority over the settings of the pads."""
    for name in config.obstacles:
        for geom in spec.body(name).geoms:
            geom.condim, geom.friction = 4, (config.mujoco.obstacle_friction, TORSION, ROLLING)
            geom.solref, geom.priority = _STIFFNESS, _OBSTACLE_PRIORITY


def let_fingers_slide(spec: mujoco.MjSpec, config: Config) -> None:
    """Add a contact pair of MuJoCo for each pad and each obstacle that can touch.

    In such a pair, the force of friction does not change the normal force. A finger can therefore slide.
    """
    pads = [geom for body in spec.bodies for geom in body.geoms if geom.priority == PAD_PRIORITY and geom.contype]
    friction = config.mujoco.obstacle_friction
    for name in config.obstacles:
        for geom in (geom for geom in spec.body(name).geoms if geom.contype):
            for pad in pads:
                finger = pad.parent.name
                if any(spec.exclude("|".join(pair)) is not None for pair in ((finger, name), (name, finger))):
                    continue
                pair = _add_pair(spec, pad, geom, friction)
                pair.solref, pair.solreffriction = _STIFFNESS, _SLIDING


# Contacts of soft objects: MuJoCo's impedance (``solimp``), which is a share of the force that would stop a rigid body;
# the time in which foam returns to its first shape [s]; and the number of points on which a box stands.
_SHARE, _RECOVERY, _CORNERS = 0.9, 0.02, 4


def let_objects_yield(spec: mujoco.MjSpec, config: Config) -> None:
    """Set the contacts of soft objects with obstacles. MuJoCo's ``solref`` is a stiffness per mass and corner."""
    for name, thing in config.mujoco.objects.items():
        if thing.stiffness is None:
            continue
        stiffness = thing.stiffness * (1.0 - _SHARE) / (_CORNERS * thing.mass)  # [1/s^2]
        for shape in spec.body(name).geoms:
            for geom in (geom for obstacle in config.obstacles for geom in spec.body(obstacle).geoms if geom.contype):
                pair = _add_pair(spec, shape, geom, config.mujoco.obstacle_friction)
                pair.solref = -stiffness, -stiffness * _RECOVERY
                pair.solimp[:2] = _SHARE, _SHARE


def _add_pair(spec: mujoco.MjSpec, one: mujoco.MjsGeom, other: mujoco.MjsGeom, friction: float) -> mujoco.MjsPair:
    for shape in (one, other):  # Both shapes need a name, because a pair refers to its shapes by their names.
        number = next(i for i, geom in enumerate(shape.parent.geoms) if geom == shape)
        shape.name = shape.name or f"{shape.parent.name}_shape_{number}"
    pair = spec.add_pair(geomname1=one.name, geomname2=other.name)
    pair.condim, pair.friction = 4, (friction, friction, TORSION, ROLLING, ROLLING)
    return pair
