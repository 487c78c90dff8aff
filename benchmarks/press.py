"""How does the table feel a finger that presses on it on purpose, in torque mode?

The left tool is asked to go straight down until :data:`COMMANDED` inside the table, much faster than contact allows. It
stays, slides away from the arm's base or towards it while it presses, and is lifted. That way is the hardest: the arm
moves in its own plane, where pressing and sliding are coupled by its masses. Controller and impedance are whole. Forces
are read from MuJoCo's contacts at every tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import mujoco
import numpy as np
import pinocchio as pin
import typer

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config, load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import TorqueDrive
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.pairs import LinkClass, Role, link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.fault_injection import TABLE_ONLY, with_contact
from q2r2_control.viewer.tables import record_table

COMMANDED = 0.010  # inside the table [m]
_ARM, _TABLE = "left", "table"
_Y = 0.40  # of all the run [m]
_SPAN = (0.50, 0.60)  # of x, over which it slides [m]
_HEIGHT, _LOWEST, _RISE = 0.30, 0.10, 0.10  # of the tool before, at least, and after [m]
_APPROACH_SPEED = 0.5  # asked for, far above what contact allows [m/s]
# Times at which parts of the run begin [s].
_DOWN, _SLIDING, _LIFT, _END = 2.5, 6.0, 8.5, 10.5
_APPROACH, _SLIDE_TIME = 2.0, 1.5  # [s]
_SETTLED = 1.0  # of a part, after which force is steady [s]
NOTES = (
    "impact: speed [m/s] of the tool when it first touches, and the greatest force [N] in the 0.25 s after it",
    "steady: mean force while it stays; spring, bound: stiffness times the way from the reference, times the depth",
    "    that is allowed; slide: mean force and extremes until the lift [N]",
    "slide error: of the tool at the slide's end; friction lag: what it has to be, friction times force over stiffness",
    "rotor share: of the rotors' inertia that the joints feel (mujoco.rotor_share); friction: mujoco.obstacle_friction",
)


class PressSlide(StrEnum):
    """Where a press slides to, as seen from the arm's base."""

    AWAY = "away"
    TOWARDS = "towards"


@dataclass(frozen=True, slots=True)
class PressFigures:
    """One press. Forces are the table's normal force on the hand [N]."""

    slide: PressSlide
    rotor_share: float
    friction: float
    impact_speed: float  # of the tool in the tick before it first touches [m/s]
    impact_force: float  # greatest in the first 0.25 s of contact [N]
    steady_force: float  # mean while it stays [N]
    spring_force: float  # stiffness times how far the tool is above its reference meanwhile [N]
    largest_force: float  # of all the run [N]
    bound: float  # stiffness times the depth that the reference may have [N]
    bounce_s: float  # without contact from the first touch to the slide [s]
    lost_contact_s: float  # the same from there to the lift [s]
    slide_error_mm: float  # tool behind its target along the table when the slide has just ended [mm]
    friction_lag_mm: float  # friction times the mean force over the stiffness: what that has to be [mm]
    slide_force: float  # mean while it slides [N]
    slide_least: float  # and the extremes [N]
    slide_largest: float
    violations: int  # of the controller's promises, over all ticks


# Slides with the rotor share and the friction of each: metal on wood, the cell's own, and rubber that grips well.
PRESSES = (
    *((PressSlide.AWAY, 1.0, friction) for friction in (0.3, 0.6, 0.9)),
    (PressSlide.TOWARDS, 1.0, 0.9),
    *((slide, 0.1, 0.9) for slide in PressSlide),
)


def run_press(config: Config, slide: PressSlide, rotor_share: float, friction: float) -> PressFigures:
    """Press with the cell of ``config``, in which the left fingers and the table may touch.

    Raises :class:`ConfigError` where nothing of that arm may touch the table.
    """
    mujoco = config.mujoco.model_copy(update={"rotor_share": rotor_share, "obstacle_friction": friction})
    # In simulated time no solution is late, however busy the machine is.
    control = config.control.model_copy(update={"solve_time_limit": None})
    config = config.model_copy(update={"mujoco": mujoco, "control": control})
    robot = Robot.from_config(config)
    bound = config.impedance.translational_stiffness * _depth(robot, config)
    trace = _press(robot, config, slide)
    return _figures(config, slide, bound, trace)


@dataclass(frozen=True, slots=True)
class _Trace:
    """One run, by ticks (n,)."""

    force: Array  # of the table [N]
    height: Array  # of the tool [m]
    reference_height: Array
    behind: Array  # of the target, along the slide [m]
    violations: int


def _press(robot: Robot, config: Config, slide: PressSlide) -> _Trace:
    controller = CartesianController(robot, config.control)
    drive, plant = TorqueDrive(robot, config), MujocoPlant(robot, config)
    contract = Contract(controller, random=np.random.default_rng(0))
    start, data = controller.tool_pose(_ARM), robot.model.createData()
    drive.reset(plant.state())
    dt = 1.0 / config.nominal_rate_hz
    touch: float | None = None  # height of the tool when it first touched [m]
    ticks = round(_END / dt)
    force, height, behind, reference_height = (np.zeros(ticks) for _ in range(4))
    for i in range(ticks):
        t = i * dt
        state = plant.state()
        target = pin.SE3(start.rotation, _asked(t, start.translation, touch, slide))
        reference = controller.step({_ARM: target}, dt)
        contract.observe(reference, dt)
        pin.forwardKinematics(robot.model, data, state.q)
        measured = pin.updateFramePlacement(robot.model, data, robot.arms[_ARM].frame_id).translation
        height[i], behind[i] = measured[2], _along(slide)[0] * (target.translation[0] - measured[0])
        reference_height[i] = controller.tool_pose(_ARM).translation[2]
        plant.apply(drive.command(reference, state, {_ARM: 0.0}, dt))
        plant.advance(dt)
        force[i] = _pressing_force(plant)
        if touch is None and force[i] > 0.0:
            touch = height[i]
    plant.close()
    if touch is None:
        raise ConfigError(f"obstacles.{_TABLE}: not reached by arm {_ARM}; allowed: as in config/dual_iiwa7.yaml")
    violations = sum(margin.violations for margin in contract.margins.values())
    return _Trace(force, height, reference_height, behind, violations)


def _pressing_force(plant: MujocoPlant) -> float:
    """Sum of the normal forces [N] of all contacts between the arm and the table."""
    model, data, total, wrench = plant.model, plant.data, 0.0, np.zeros(6)
    for i in range(data.ncon):
        geoms = data.contact[i].geom1, data.contact[i].geom2
        first, second = sorted((model.body(model.geom_bodyid[geom]).name for geom in geoms), key=_TABLE.__eq__)
        if first.startswith(_ARM) and second == _TABLE:
            mujoco.mj_contactForce(model, data, i, wrench)
            total += float(wrench[0])
    return total


def _figures(config: Config, slide: PressSlide, bound: float, trace: _Trace) -> PressFigures:
    dt, force, height = 1.0 / config.nominal_rate_hz, trace.force, trace.height
    first = int(np.flatnonzero(force > 0.0)[0])
    stays = slice(round((_DOWN + _SETTLED) / dt), round(_SLIDING / dt))
    end = round((_SLIDING + _SLIDE_TIME) / dt)
    slides, pressed = slice(stays.stop, end), slice(stays.stop, round(_LIFT / dt))
    settings, sliding = config.impedance, float(force[slides].mean())
    share, friction = config.mujoco.rotor_share, config.mujoco.obstacle_friction
    spring = settings.translational_stiffness * (height - trace.reference_height)[stays].mean()
    return PressFigures(
        slide=slide,
        rotor_share=share,
        friction=friction,
        impact_speed=float(height[first - 1] - height[first]) / dt,
        impact_force=float(force[first : first + round(0.25 / dt)].max()),
        steady_force=float(force[stays].mean()),
        spring_force=float(spring),
        largest_force=float(force.max()),
        bound=bound,
        bounce_s=float(np.count_nonzero(force[first : slides.start] <= 0.0)) * dt,
        lost_contact_s=float(np.count_nonzero(force[pressed] <= 0.0)) * dt,
        slide_error_mm=1e3 * float(trace.behind[end]),
        friction_lag_mm=1e3 * friction * sliding / settings.translational_stiffness,
        slide_force=sliding,
        slide_least=float(force[pressed].min()),
        slide_largest=float(force[pressed].max()),
        violations=trace.violations,
    )


def _along(slide: PressSlide) -> Array:
    """Direction (3,) of a slide."""
    return np.array([1.0 if slide is PressSlide.AWAY else -1.0, 0.0, 0.0])


def _asked(t: float, start: Array, touch: float | None, slide: PressSlide) -> Array:
    """Where the tool is asked to be (3,) [m]."""
    begin, end = _SPAN if slide is PressSlide.AWAY else _SPAN[::-1]
    above = np.array([begin, _Y, _HEIGHT])
    if t < _DOWN:
        return start + minimum_jerk(min(t / _APPROACH, 1.0)) * (above - start)
    bottom = -np.inf if touch is None else touch - COMMANDED
    z = max(_HEIGHT - _APPROACH_SPEED * (t - _DOWN), bottom, _LOWEST)
    x = begin + (end - begin) * minimum_jerk(min(max(t - _SLIDING, 0.0) / _SLIDE_TIME, 1.0))
    if t > _LIFT:
        z += minimum_jerk(min((t - _LIFT) / _APPROACH, 1.0)) * _RISE
    return np.array([x, _Y, z])


def _depth(robot: Robot, config: Config) -> float:
    """How far the reference of the left fingers may get inside the table [m]."""
    names, kept = pair_names(robot.collision_model), kept_distances(robot, config.control).values
    depths = [
        -float(kept[p])
        for p, pair in enumerate(names)
        if {link_of(name) for name in pair} & {_TABLE}
        and any(robot.roles[link_of(name)] == Role(LinkClass.FINGER, frozenset({_ARM})) for name in pair)
    ]
    if not depths or max(depths) <= 0.0:
        raise ConfigError(
            f"control.contact_allowed: nothing of arm {_ARM}'s fingers and {_TABLE}; allowed: such a pair"
        )
    return max(depths)


def main(json: Json = False) -> None:
    """Press a finger on the table in torque mode, and print the forces in MuJoCo; exit 1 if a promise was broken."""
    config = with_contact(load_config(DEMO_CONFIG), TABLE_ONLY)
    figures = []
    for press in PRESSES:
        print_progress(f"slides {press[0]}, rotor share {press[1]:g}, friction {press[2]:g}")
        figures.append(run_press(config, *press))
    title = f"{config.name}: {1e3 * COMMANDED:g} mm commanded into the table, torque mode, MuJoCo"
    print_report({"cell": config.name, "presses": figures}, (record_table(title, figures, NOTES),), json)
    raise typer.Exit(1 if any(press.violations for press in figures) else 0)


if __name__ == "__main__":
    typer.run(main)
