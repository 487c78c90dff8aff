"""All settings of motion control, with units and ranges."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from q2r2_control.config.strict import StrictModel, validated
from q2r2_control.errors import ConfigError, check_kind, shown

EQUAL = "equal"
_LIVE = "live"  # Marks a setting that may change while a controller runs.
LiveFloat = Annotated[float, _LIVE]
_Weight = Annotated[float, Field(ge=0, le=1)]
Weights = tuple[_Weight, _Weight, _Weight]
Distance = Annotated[float, Field(ge=0, le=0.2)]  # [m]
# A negative distance is the allowed overlap of a box whose size is known only roughly [m].
ObjectDistance = Annotated[float, Field(ge=-0.05, le=0.2)]
JerkLimit = Annotated[float, Field(ge=200, le=1e6)]  # [rad/s^3]
LinkPattern = Annotated[str, Field(min_length=1)]
ObstacleName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]


class DistanceSettings(StrictModel):
    """Distances that pairs keep, by the kind of their bodies. A kind that is left out has ``min_distance``.

    The joints of a gripper move its fingers, and the tool (also called the hand) is the part to which the fingers are
    attached. Obstacles include the floor. An object is the body that ``gripper.object`` describes, while it is held.
    ``arm_self`` is for pairs of two bodies of one arm, and for pairs of an arm and the rest of its robot. The bodies of
    an arm include the object that it holds. All other keys without obstacles are for bodies of two different arms.
    """

    arm_arm: Distance | None = Field(None, description="links of two arms, bases included [m]")
    arm_self: Distance | None = Field(None, description="one arm with tool and fingers, among themselves [m]")
    arm_obstacle: Distance | None = Field(None, description="an arm's links and obstacles [m]")
    tool_arm: Distance | None = Field(None, description="a hand and the other arm's links [m]")
    tool_tool: Distance | None = Field(None, description="hand and hand [m]")
    tool_obstacle: Distance | None = Field(None, description="a hand and obstacles [m]")
    finger_arm: Distance | None = Field(None, description="fingers and the other arm's links [m]")
    finger_tool: Distance | None = Field(None, description="fingers and the other hand [m]")
    finger_finger: Distance | None = Field(None, description="fingers of both hands [m]")
    finger_obstacle: Distance | None = Field(None, description="fingers and obstacles [m]")
    object_arm: ObjectDistance | None = Field(None, description="a held object and the other arm's links [m]")
    object_tool: ObjectDistance | None = Field(0.005, description="a held object and the other hand [m]")
    object_object: ObjectDistance | None = Field(0.0, description="two objects that are held [m]")
    object_obstacle: ObjectDistance | None = Field(0.0, description="a held object and obstacles [m]")


class NamedPairDistance(StrictModel):
    """A distance for the pairs of bodies whose names match ``pair``."""

    pair: tuple[LinkPattern, LinkPattern] = Field(
        description="two links in any order; * stands for any characters and ? for one"
    )
    distance: Distance = Field(description="distance that the pairs keep [m]")


class ContactPair(StrictModel):
    """Pairs of bodies, by their names, that may touch in torque mode. In the other modes they keep their distance.

    The reference may penetrate a body by ``depth``. The impedance then presses with at most its stiffness times this
    depth.
    """

    pair: tuple[LinkPattern, LinkPattern] = Field(description="as in control.pairs")
    depth: float = Field(0.015, ge=0.001, le=0.03, description="how far the reference may get inside [m]")
    speed: float = Field(0.03, ge=0.005, le=0.2, description="closing speed before and in contact [m/s]")


_LONGEST_SOLVE = 0.005  # Default of solve_time_limit in real time [s].


class ControllerSettings(StrictModel):
    """Settings of :class:`CartesianController`; every range is checked when an instance is created."""

    solver: str = Field(
        "daqp",
        description="solver of the QP: daqp, osqp, or another that qpsolvers finds; --solver NAME replaces it",
    )
    solver_options: dict[str, Any] = Field(
        {}, description="keyword arguments of that solver; they are not used with another one"
    )
    solve_time_limit: float | None = Field(
        None,
        gt=0,
        le=0.1,
        description="a later solution counts as failed [s]; null: 5 ms in real time. Simulated time has no limit",
    )
    max_substep: float = Field(0.002, gt=0, le=0.02, description="a longer dt is split into equal parts below this [s]")

    acceleration_limit: float = Field(
        10.0,
        gt=0,
        le=100,
        description="largest acceleration of every joint, if the joint's own limit is not smaller [rad/s^2]",
    )
    velocity_scale: float = Field(1.0, gt=0, le=1, description="fraction of the robot's velocity limits")
    position_margin: float = Field(
        0.01, ge=0, le=0.5, description="distance that joints keep from their position limits [rad]"
    )
    limits: Literal["driver", "model"] = Field(
        "driver",
        description="driver: with plant fri or a preset lbr_*, position_margin is 0.105 rad at least, and "
        "velocity_scale 0.95 at most, with a preset lbr_* 0.85",
    )
    tool_speed_limit: float | None = Field(
        None,
        ge=0.02,
        le=3,
        description="no tool of the reference is ever faster, whatever the solver returns [m/s]; null: no such limit",
    )
    jerk_limit: JerkLimit | tuple[JerkLimit, ...] | None = Field(
        None,
        description="largest change of acceleration of commanded positions and velocities: one number, or one for each "
        "joint [rad/s^3]; null: no such limit",
    )
    recovery_velocity: float = Field(
        0.2, gt=0, le=1, description="speed back inside of a joint that is outside its limits [rad/s]"
    )

    min_distance: Annotated[Distance, _LIVE] = Field(
        0.02, description="distance that monitored pairs keep, unless distances or pairs say otherwise [m]"
    )
    distances: DistanceSettings = Field(DistanceSettings(), description="the same by the kind of the bodies")
    pairs: tuple[NamedPairDistance, ...] = Field(
        (), description="the same by the names of the bodies; the last entry that fits counts"
    )
    contact_allowed: tuple[ContactPair, ...] = Field(
        (), description="pairs that may touch in torque mode; the last entry that fits counts"
    )
    moving_obstacles: tuple[ObstacleName, ...] = Field(
        (), max_length=16, description="names of obstacles that may appear, move and disappear while a controller runs"
    )
    distance_buffer: float = Field(
        0.002,
        ge=1e-4,
        le=0.05,
        description="the QP plans to stop a pair this much earlier, at most half of its distance [m]",
    )
    separation_gain: LiveFloat = Field(
        10.0, gt=0, le=50, description="closing speed per metre that would remain after a stop [1/s]"
    )
    separation_recovery_speed: float = Field(
        0.05, gt=0, le=0.5, description="speed at which a pair that is too close moves apart [m/s]"
    )

    priority: str = Field(EQUAL, description="equal, or the arm that the other one gives way to")
    yield_weight: LiveFloat = Field(0.01, gt=0, le=1, description="factor of the costs of the arm that gives way")

    position_gain: LiveFloat = Field(8.0, gt=0, le=50, description="gain of the position error [1/s]")
    rotation_gain: LiveFloat = Field(8.0, gt=0, le=50, description="gain of the rotation error [1/s]")
    position_weights: Weights = Field(
        (1.0, 1.0, 1.0), description="weights of the position error along the world's x, y, z"
    )
    rotation_weights: Weights = Field(
        (1.0, 1.0, 1.0),
        description="weights of the rotation error about the tool's own x, y, z; 0 leaves that rotation free",
    )
    max_linear_speed: LiveFloat = Field(1.0, gt=0, le=3, description="largest linear speed of a tool task [m/s]")
    max_angular_speed: LiveFloat = Field(2.5, gt=0, le=10, description="largest angular speed of a tool task [rad/s]")
    linear_deceleration: LiveFloat = Field(
        2.0, gt=0, le=50, description="deceleration with which a tool approaches its target [m/s^2]"
    )
    angular_deceleration: LiveFloat = Field(
        5.0, gt=0, le=100, description="deceleration with which a tool turns to its target [rad/s^2]"
    )
    feed_forward_time: float = Field(
        0.02, gt=0, le=1, description="time constant that smooths the target's velocity [s]"
    )

    posture_gain: LiveFloat = Field(1.0, ge=0, le=20, description="pull towards the home posture [1/s]")
    posture_speed: float = Field(0.5, gt=0, le=3, description="largest speed of that pull [rad/s]")
    posture_weight: LiveFloat = Field(
        1e-3,
        gt=0,
        le=1,
        description="weight of the posture task, where the tool task has 1; it also regularises the QP",
    )
    stretch_gain: LiveFloat = Field(
        10.0, gt=0, le=200, description="largest gain of an arm that is stretched out [1/s]"
    )
    tasks: dict[str, dict[str, Any]] = Field(
        {}, description="tasks of other packages, by their entry point's name, with the settings of each"
    )

    @field_validator("moving_obstacles")
    @classmethod
    def _are_different(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("allowed: each name once")
        return names

    def without_contact(self) -> ControllerSettings:
        """Return the settings for modes in which the arms do not yield. Their ``contact_allowed`` is empty."""
        return self.model_copy(update={"contact_allowed": ()}) if self.contact_allowed else self

    def without_jerk_limit(self) -> ControllerSettings:
        """Return the settings for modes whose commands are torques. Their ``jerk_limit`` is None."""
        return self if self.jerk_limit is None else self.model_copy(update={"jerk_limit": None})

    def with_solver(self, name: str | None) -> ControllerSettings:
        """Return the settings with the solver called ``name``; None keeps the solver.

        If the solver changes, ``solver_options`` is empty, because the options were for the old solver.
        """
        if name is None or name == self.solver:
            return self
        return self.model_copy(update={"solver": name, "solver_options": {}})

    def timed(self, realtime: bool) -> ControllerSettings:
        """Return the settings with a ``solve_time_limit`` in real time, and without one in simulated time.

        Whether a solution is late depends on the speed of the computer, and a repeatable run must not depend on it. In
        real time, the arms must not wait for a solver that blocks.
        """
        limit = (self.solve_time_limit or _LONGEST_SOLVE) if realtime else None
        return self.model_copy(update={"solve_time_limit": limit})

    def changed(self, values: Mapping[str, Any]) -> ControllerSettings:
        """Return the settings with new ``values`` for some of the settings in ``LIVE``, by name.

        Raises:
            ConfigError: If a name is not in ``LIVE``, or if a value is not allowed.
        """
        check_kind("control", values, Mapping, f"new values by name, of {', '.join(LIVE)}")
        for name, value in values.items():
            if name not in LIVE:
                key = name if isinstance(name, str) and name.isidentifier() else shown(name)
                raise ConfigError(f"control.{key} = {shown(value)}: while a controller runs: {', '.join(LIVE)}")
        return validated(ControllerSettings, "control.", self.model_dump() | dict(values))

    @property
    def largest_distance(self) -> tuple[str, float]:
        """Return the key and the value [m] of the largest distance that these settings may ask a pair to keep."""
        by_class = {f"distances.{name}": value for name, value in self.distances if value is not None}
        by_name = {f"pairs[{i}].distance": named.distance for i, named in enumerate(self.pairs)}
        return max((("min_distance", self.min_distance), *by_class.items(), *by_name.items()), key=lambda item: item[1])


def check_priority(priority: str, arms: Collection[str]) -> None:
    """Raise :class:`ConfigError` unless ``priority`` is ``equal`` or one of ``arms``."""
    if priority != EQUAL and priority not in arms:
        raise ConfigError(f"control.priority = {priority!r:.60}: allowed here: {', '.join((EQUAL, *arms))}")


class WallSettings(StrictModel):
    """The force that pushes measured links apart if they are nearer than the distance that their pair keeps."""

    stiffness: float = Field(10000.0, gt=0, le=100000, description="force per depth below a pair's distance [N/m]")
    damping_ratio: float = Field(1.0, ge=0.2, le=2, description="damping ratio at the effective mass of each pair")
    maximum_force: float = Field(400.0, gt=0, le=2000, description="largest force between a pair of links [N]")


class ImpedanceSettings(StrictModel):
    """Settings of :class:`ImpedanceController`. Nothing here may be zero or negative: a stiffness or a damping of -1,
    meant as "automatic", would drive an arm instead of holding it."""

    translational_stiffness: LiveFloat = Field(
        2000.0, gt=0, le=5000, description="stiffness of the tool in all directions [N/m]"
    )
    rotational_stiffness: LiveFloat = Field(
        200.0, gt=0, le=300, description="stiffness of the tool about all axes [Nm/rad]"
    )
    damping_ratio: LiveFloat = Field(
        1.0, ge=0.1, le=2, description="damping ratio of every mode of the tool; 1: no overshoot"
    )
    nullspace_stiffness: LiveFloat = Field(
        50.0, gt=0, le=500, description="stiffness towards the posture of the reference [Nm/rad]"
    )
    nullspace_damping_ratio: LiveFloat = Field(1.0, ge=0.1, le=2, description="damping ratio of the posture's motion")
    max_position_error: float = Field(0.1, gt=0, le=1, description="a larger position error is clipped to this [m]")
    max_rotation_error: float = Field(0.5, gt=0, le=3, description="a larger rotation error is clipped to this [rad]")
    limit_distance: float = Field(
        0.1, gt=0, le=0.5, description="a joint that is nearer to its limit is pushed back [rad]"
    )
    limit_stiffness: float = Field(300.0, gt=0, le=5000, description="stiffness of that push [Nm/rad]")
    limit_damping: float = Field(20.0, gt=0, le=200, description="damping of that push [Nms/rad]")
    torque_scale: float = Field(1.0, gt=0, le=1, description="fraction of the robot's torque limits")
    torque_rate_limit: float = Field(5000.0, gt=0, le=1e5, description="largest change of torque of every joint [Nm/s]")
    ramp_time: float = Field(
        0.5, ge=0.01, le=10, description="time that a change of stiffness or damping takes at run time [s]"
    )
    wall: WallSettings = WallSettings()


class AdmittanceSettings(StrictModel):
    """The impedance that a tool shows in position mode, on plants that report external torque."""

    enabled: bool = Field(False, description="the admittance is on; it needs a plant that measures external torque")
    stiffness: float = Field(1000.0, ge=10, le=20000, description="stiffness in all directions [N/m]")
    rotation_stiffness: float = Field(30.0, ge=0.5, le=1000, description="stiffness about all axes [Nm/rad]")
    damping_ratio: float = Field(
        1.0, ge=0.1, le=5, description="damping ratio of the tool; 1: the fastest return without overshoot"
    )
    mass: float = Field(10.0, ge=0.5, le=200, description="virtual mass of the tool [kg]")
    inertia: float = Field(0.3, ge=0.01, le=20, description="virtual inertia of the tool [kg m^2]")
    # The mass in the tool's model can be wrong by 0.2 kg. The default force is the weight of this mass. The default
    # torque is the torque of this weight at a distance of 0.15 m from the tool frame.
    force_dead_band: float = Field(2.0, ge=0, le=50, description="a smaller force moves nothing [N]")
    torque_dead_band: float = Field(0.3, ge=0, le=10, description="a smaller torque moves nothing [Nm]")
    filter_time: float = Field(0.01, ge=0, le=0.5, description="time constant of the wrench's low-pass [s]")
    max_displacement: float = Field(0.1, gt=0, le=0.5, description="largest displacement from the target [m]")
    max_rotation: float = Field(0.5, gt=0, le=1.5, description="largest rotation from the target [rad]")


def _live_fields(settings: type[StrictModel]) -> tuple[str, ...]:
    return tuple(name for name, field in settings.model_fields.items() if _LIVE in field.metadata)


LIVE = _live_fields(ControllerSettings)  # Names of the settings that may change while a controller runs.
LIVE_IMPEDANCE = _live_fields(ImpedanceSettings)  # Names of impedance settings that may change at run time.


class SupervisionSettings(StrictModel):
    """Limits of the measured states of a plant, and of streams of targets."""

    state_timeout: float = Field(
        0.1, ge=0.01, le=1, description="the arms stop if no state was measured for this time [s]"
    )
    unusable_time: float = Field(
        0.05, ge=0, le=0.5, description="states that are not finite are ignored for this time, then the arms stop [s]"
    )
    settle_time: float = Field(
        0.1, ge=0.02, le=10, description="states have to be valid and at rest for this time before arms may move [s]"
    )
    max_deviation: float = Field(
        0.15, ge=0.01, le=3, description="largest deviation of a measured joint from its reference [rad]"
    )
    max_deviation_torque: float = Field(
        1.5, ge=0.01, le=3, description="the same in torque mode, where an arm yields if it is pushed [rad]"
    )
    max_deviation_external: float = Field(
        0.6, ge=0.01, le=3, description="the same with an external controller, which may lag behind its targets [rad]"
    )
    deviation_time: float = Field(
        0.5, ge=0.05, le=10, description="a larger deviation for longer than this time stops the arms [s]"
    )
