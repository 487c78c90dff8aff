"""A finger that presses on the table on purpose, in torque mode: the whole of controller, impedance and MuJoCo.

The left tool is asked to go straight down until :data:`COMMANDED` inside the table, much faster than contact allows,
stays, slides away from the arm's base while it presses, and is lifted. That way is the hardest: the arm moves in its
own plane, where pressing and sliding are coupled by its masses. What the table feels is read from MuJoCo's contacts at
every tick.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.config import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.torque import TorqueDrive
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.plants.mujoco_contacts import pressing_force
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.link_roles import Part, Role
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract

COMMANDED = 0.010  # inside the table [m]
_ARM, _TABLE = "left", "table"
_PLACE = (0.50, 0.40)  # x and y [m]
_HEIGHT, _LOWEST, _RISE = 0.30, 0.10, 0.10  # of the tool before, at least, and after [m]
_APPROACH_SPEED = 0.5  # asked for, far above what contact allows [m/s]
_SLIDE = 0.10  # [m]
# Times at which parts of the run begin [s].
_DOWN, _SLIDING, _LIFT, _END = 2.5, 6.0, 8.5, 10.5
_APPROACH, _SLIDE_TIME = 2.0, 1.5  # [s]
_SETTLED = 1.0  # of a part, after which force is steady [s]


@dataclass(frozen=True, slots=True)
class PressFigures:
    """One press. Forces are the table's normal force on the hand [N]."""

    rotor_share: float
    impact_speed: float  # of the tool in the tick before it first touches [m/s]
    impact_force: float  # greatest in the first 0.25 s of contact [N]
    steady_force: float  # mean while it stays [N]
    spring_force: float  # stiffness times how far the tool is above its reference meanwhile [N]
    largest_force: float  # of all the run [N]
    bound: float  # stiffness times the depth that the reference may have [N]
    bounce_s: float  # without contact from the first touch to the slide [s]
    lost_contact_s: float  # the same from there to the lift [s]
    slide_error_mm: float  # tool against target along the table at the slide's end [mm]
    slide_force: float  # mean while it slides and after [N]
    violations: int  # of the controller's promises, over all ticks


def run_press(config: Config, rotor_share: float) -> PressFigures:
    """Press with the cell of ``config``, in which the left fingers and the table may touch.

    Raises :class:`ConfigError` where nothing of that arm may touch the table.
    """
    mujoco = config.mujoco.model_copy(update={"rotor_share": rotor_share})
    config = config.model_copy(update={"mujoco": mujoco})
    robot = Robot.from_config(config)
    depth = _depth(robot, config)
    controller = CartesianController(robot, config.control)
    drive, plant = TorqueDrive(robot, config), MujocoPlant(robot, config)
    contract = Contract(controller, random=np.random.default_rng(0))
    start, data = controller.tool_pose(_ARM), robot.model.createData()
    drive.reset(plant.state())
    dt = 1.0 / config.loop_rate_hz
    touch: float | None = None  # height of the tool when it first touched [m]
    ticks = round(_END / dt)
    force, height, along, reference_height = (np.zeros(ticks) for _ in range(4))
    frame = robot.arms[_ARM].frame_id
    for i in range(ticks):
        t = i * dt
        state = plant.state()
        target = pin.SE3(start.rotation, _asked(t, start.translation, touch))
        reference = controller.step({_ARM: target}, dt)
        contract.observe(reference, dt)
        pin.forwardKinematics(robot.model, data, state.q)
        measured = pin.updateFramePlacement(robot.model, data, frame).translation
        height[i], along[i] = measured[2], measured[0] - target.translation[0]
        reference_height[i] = controller.tool_pose(_ARM).translation[2]
        plant.apply(drive.command(reference, state, {_ARM: 0.0}, dt))
        plant.advance(dt)
        force[i] = pressing_force(
            plant.model, plant.data, lambda link: link.startswith(_ARM), lambda link: link == _TABLE
        )
        if touch is None and force[i] > 0.0:
            touch = height[i]
    plant.close()
    touching = np.flatnonzero(force > 0.0)
    if touch is None:
        raise ConfigError(f"obstacles.{_TABLE}: not reached by arm {_ARM}; allowed: as in config/dual_iiwa7.yaml")
    first = int(touching[0])
    lift, stays = round(_LIFT / dt), slice(round((_DOWN + _SETTLED) / dt), round(_SLIDING / dt))
    slides = slice(round(_SLIDING / dt), lift)
    stiffness = config.impedance.translational_stiffness
    return PressFigures(
        rotor_share=rotor_share,
        impact_speed=float(height[first - 1] - height[first]) / dt,
        impact_force=float(force[first : first + round(0.25 / dt)].max()),
        steady_force=float(force[stays].mean()),
        spring_force=float(stiffness * (height - reference_height)[stays].mean()),
        largest_force=float(force.max()),
        bound=stiffness * depth,
        bounce_s=float(np.count_nonzero(force[first : slides.start] <= 0.0)) * dt,
        lost_contact_s=float(np.count_nonzero(force[slides] <= 0.0)) * dt,
        slide_error_mm=1e3 * float(abs(along[lift - 1])),
        slide_force=float(force[slides].mean()),
        violations=sum(margin.violations for margin in contract.margins.values()),
    )


def _asked(t: float, start: Array, touch: float | None) -> Array:
    """Where the tool is asked to be (3,) [m]."""
    above = np.array([*_PLACE, _HEIGHT])
    if t < _DOWN:
        return start + minimum_jerk(min(t / _APPROACH, 1.0)) * (above - start)
    bottom = -np.inf if touch is None else touch - COMMANDED
    z = max(_HEIGHT - _APPROACH_SPEED * (t - _DOWN), bottom, _LOWEST)
    x = _PLACE[0] + _SLIDE * minimum_jerk(min(max(t - _SLIDING, 0.0) / _SLIDE_TIME, 1.0))
    if t > _LIFT:
        z += minimum_jerk(min((t - _LIFT) / _APPROACH, 1.0)) * _RISE
    return np.array([x, _PLACE[1], z])


def _depth(robot: Robot, config: Config) -> float:
    """How far the reference of the left fingers may get inside the table [m]."""
    names, kept = pair_names(robot.collision_model), kept_distances(robot, config.control).values
    depths = [
        -float(kept[p])
        for p, pair in enumerate(names)
        if {link_of(name) for name in pair} & {_TABLE}
        and any(robot.roles[link_of(name)] == Role(Part.FINGER, frozenset({_ARM})) for name in pair)
    ]
    if not depths or max(depths) <= 0.0:
        raise ConfigError(
            f"control.contact_allowed: nothing of arm {_ARM}'s fingers and {_TABLE}; allowed: such a pair"
        )
    return max(depths)
