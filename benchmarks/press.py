"""Which forces does a finger exert on the table if it presses on purpose, in torque mode?

The target of the left tool goes straight down to :data:`COMMANDED_DEPTH` below the table's surface, much faster than
contact allows. The target stays there, slides away from the arm's base or towards the base while the tool presses, and
rises again. The slide has one of these two directions because they are the hardest: the arm then moves in its own
plane, where its masses couple pressing and sliding. The controller and the impedance are as in a usual run. Forces are
read from MuJoCo's contacts at every tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import mujoco
import numpy as np
import pinocchio as pin
import typer

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
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

COMMANDED_DEPTH = 0.010  # Depth of the target inside the table [m].
_ARM, _TABLE = "left", "table"
_TOOL_Y = 0.40  # The tool's y during the whole run [m].
_SLIDE_RANGE = (0.50, 0.60)  # Range of x over which the tool slides [m].
# Height of the target before the press, its least height, and its rise after the press [m].
_START_HEIGHT, _MIN_HEIGHT, _LIFT_HEIGHT = 0.30, 0.10, 0.10
_APPROACH_SPEED = 0.5  # Speed of the target, far above the speed that contact allows [m/s].
# Times when the tool goes down, slides and is lifted, and when the run ends [s].
_DOWN_BEGINS_S, _SLIDE_BEGINS_S, _LIFT_BEGINS_S, _RUN_ENDS_S = 2.5, 6.0, 8.5, 10.5
_APPROACH_S, _SLIDE_S = 2.0, 1.5  # Durations of the approach and of the slide [s].
_SETTLING_S = 1.0  # Time from the start of a press until its force is steady [s].
NOTES = (
    "impact: Speed of the tool at the first touch [m/s], and largest force within the next 0.25 s [N].",
    "steady: Mean force while the tool stays [N].",
    "spring: Stiffness times the distance of the tool from its reference [N].",
    "bound: Stiffness times the depth that control.contact_allowed allows the reference [N].",
    "slide: Mean force while the tool slides, and its extremes until the lift [N].",
    "slide error: Error of the tool at the end of the slide.",
    "friction lag: Error that friction causes, which is friction times force divided by stiffness.",
    "rotor share: Share of the rotors' inertia that the joints feel (mujoco.rotor_share).",
    "friction: Coefficient mujoco.obstacle_friction.",
)


class PressSlide(StrEnum):
    """The direction in which a press slides, as seen from the arm's base."""

    AWAY = "away"
    TOWARDS = "towards"


@dataclass(frozen=True, slots=True)
class PressFigures:
    """The figures of one press. Forces are the table's normal force on the hand [N]."""

    slide: PressSlide
    rotor_share: float
    friction: float
    impact_speed: float  # Speed of the tool in the tick before it first touches the table [m/s].
    impact_force: float  # Largest force in the first 0.25 s of contact [N].
    steady_force: float  # Mean force while the tool presses without sliding [N].
    # Stiffness times the tool's mean height above its reference while the tool presses without sliding [N].
    spring_force: float
    largest_force: float  # Largest force of the whole run [N].
    bound: float  # Stiffness times the largest allowed depth of the reference [N].
    bounce_s: float  # Time without contact between the first touch and the slide [s].
    lost_contact_s: float  # Time without contact between the start of the slide and the lift [s].
    slide_error_mm: float  # Distance of the tool behind its target along the table at the end of the slide [mm].
    friction_lag_mm: float  # Slide error that friction causes: friction times mean force divided by stiffness [mm].
    slide_force: float  # Mean force while the tool slides [N].
    slide_least: float  # Least force from the start of the slide to the lift [N].
    slide_largest: float  # Largest force from the start of the slide to the lift [N].
    violations: int  # Number of broken promises of the controller, over all ticks.


# Direction of the slide, rotor share and friction coefficient. The coefficient is 0.3 (metal on wood), 0.6 (as in the
# cell), or 0.9 (rubber that grips well).
PRESSES = (
    *((PressSlide.AWAY, 1.0, friction) for friction in (0.3, 0.6, 0.9)),
    (PressSlide.TOWARDS, 1.0, 0.9),
    *((slide, 0.1, 0.9) for slide in PressSlide),
)


def run_press(config: Config, slide: PressSlide, rotor_share: float, friction: float) -> PressFigures:
    """Press with the cell of ``config``, in which the left fingers may touch the table.

    Raises :class:`ConfigError` if none of the left arm's fingers may touch the table.
    """
    mujoco = config.mujoco.model_copy(update={"rotor_share": rotor_share, "obstacle_friction": friction})
    # Time is simulated. A solution that takes long on a busy machine must therefore not count as late.
    control = config.control.model_copy(update={"solve_time_limit": None})
    config = config.model_copy(update={"mujoco": mujoco, "control": control})
    robot = Robot.from_config(config)
    bound = config.impedance.translational_stiffness * _depth(robot, config)
    trace = _press(robot, config, slide)
    return _figures(config, slide, bound, trace)


@dataclass(frozen=True, slots=True)
class _Trace:
    """The values of one run at each tick (n,)."""

    force: Array  # Normal force of the table [N].
    height: Array  # Measured height of the tool [m].
    reference_height: Array  # Height of the tool's reference [m].
    behind: Array  # Distance of the tool behind its target, along the slide [m].
    violations: int  # Number of broken promises of the controller.


def _press(robot: Robot, config: Config, slide: PressSlide) -> _Trace:
    controller = CartesianController(robot, config.control)
    drive, plant = TorqueDrive(robot, config), MujocoPlant(robot, config)
    contract = Contract(controller, random=np.random.default_rng(0))
    start, data = controller.tool_pose(_ARM), robot.model.createData()
    drive.reset(plant.state())
    dt = 1.0 / config.nominal_rate_hz
    touch: float | None = None  # Height of the tool at its first touch, None before it [m].
    ticks = round(_RUN_ENDS_S / dt)
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
        raise ConfigError(f"obstacles.{_TABLE}: arm {_ARM} does not reach it; allowed: as in config/dual_iiwa7.yaml")
    violations = sum(margin.violations for margin in contract.margins.values())
    return _Trace(force, height, reference_height, behind, violations)


def _pressing_force(plant: MujocoPlant) -> float:
    """Return the sum of the normal forces of all contacts between the arm and the table [N]."""
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
    stays = slice(round((_DOWN_BEGINS_S + _SETTLING_S) / dt), round(_SLIDE_BEGINS_S / dt))
    end = round((_SLIDE_BEGINS_S + _SLIDE_S) / dt)
    slides, pressed = slice(stays.stop, end), slice(stays.stop, round(_LIFT_BEGINS_S / dt))
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
    """Return the direction (3,) of a slide."""
    return np.array([1.0 if slide is PressSlide.AWAY else -1.0, 0.0, 0.0])


def _asked(t: float, start: Array, touch: float | None, slide: PressSlide) -> Array:
    """Return the target position of the tool (3,) [m]."""
    begin, end = _SLIDE_RANGE if slide is PressSlide.AWAY else _SLIDE_RANGE[::-1]
    above = np.array([begin, _TOOL_Y, _START_HEIGHT])
    if t < _DOWN_BEGINS_S:
        return start + minimum_jerk(min(t / _APPROACH_S, 1.0)) * (above - start)
    bottom = -np.inf if touch is None else touch - COMMANDED_DEPTH
    z = max(_START_HEIGHT - _APPROACH_SPEED * (t - _DOWN_BEGINS_S), bottom, _MIN_HEIGHT)
    x = begin + (end - begin) * minimum_jerk(min(max(t - _SLIDE_BEGINS_S, 0.0) / _SLIDE_S, 1.0))
    if t > _LIFT_BEGINS_S:
        z += minimum_jerk(min((t - _LIFT_BEGINS_S) / _APPROACH_S, 1.0)) * _LIFT_HEIGHT
    return np.array([x, _TOOL_Y, z])


def _depth(robot: Robot, config: Config) -> float:
    """Return the depth inside the table that the reference of the left fingers may reach [m]."""
    names, kept = pair_names(robot.collision_model), kept_distances(robot, config.control).values
    depths = [
        -float(kept[p])
        for p, pair in enumerate(names)
        if {link_of(name) for name in pair} & {_TABLE}
        and any(robot.roles[link_of(name)] == Role(LinkClass.FINGER, frozenset({_ARM})) for name in pair)
    ]
    if not depths or max(depths) <= 0.0:
        raise ConfigError(
            f"control.contact_allowed: no pair of arm {_ARM}'s fingers and {_TABLE}; allowed: at least one such pair"
        )
    return max(depths)


def main(json: Json = False) -> None:
    """Press a finger on the table in torque mode, and print MuJoCo's forces. Exit with 1 if a promise was broken."""
    config = with_contact(load_config(DEMO_CONFIG), TABLE_ONLY)
    figures = []
    for press in PRESSES:
        print_progress(f"slide {press[0]}, rotor share {press[1]:g}, friction {press[2]:g}")
        figures.append(run_press(config, *press))
    title = f"{config.name}: {1e3 * COMMANDED_DEPTH:g} mm commanded into the table, torque mode, MuJoCo"
    print_report({"cell": config.name, "presses": figures}, (record_table(title, figures, NOTES),), json)
    raise typer.Exit(1 if any(press.violations for press in figures) else 0)


if __name__ == "__main__":
    typer.run(main)
