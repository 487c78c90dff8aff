"""Report the parts of a cell and its faults, before anything moves."""

from __future__ import annotations

import math
import timeit
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from q2r2_control.cli.output import counted, notice_of_compiling
from q2r2_control.config.arms import HeldObjectConfig
from q2r2_control.config.cell import Config, ObstacleConfig
from q2r2_control.config.control import ContactPair
from q2r2_control.config.external import describe
from q2r2_control.config.plugin_settings import check_blocks
from q2r2_control.config.presets import RAW_WARNING
from q2r2_control.control.controller import CartesianController, check_settings
from q2r2_control.errors import MissingPackageError, Q2R2Error
from q2r2_control.plants.base import make_plant
from q2r2_control.plugins import INPUTS, PLANTS, load_class
from q2r2_control.robot.cell_parts import load_model
from q2r2_control.robot.kept_distances import kept_distances, near_at_home
from q2r2_control.robot.near_pairs import lines_to_paste
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import PairDistance, Robot
from q2r2_control.robot.stop_torque import StopTorque, stop_torques
from q2r2_control.robot.unchecked import unchecked_notes
from q2r2_control.supervision.preflight import joints_in_degrees, preflight_faults
from q2r2_control.types import DeviceControls

_NEAREST = 8
_TICKS = 300  # Number of ticks whose computing time is measured.


# Figures of a joint: positions [rad], velocity [rad/s] and torque [Nm]. For a sliding joint, units are m, m/s and N.
_JOINT = ("name", "lower", "home", "upper", "velocity", "torque")


@dataclass(frozen=True, slots=True)
class ArmCheck:
    """The parts and limits of one arm. ``tool_position`` [m] is in the world frame, with the arm at home."""

    name: str
    model: str
    flange: str | None  # The flange's model or its sizes; None without a flange.
    tool_model: str | None
    tool_frame: str
    tool_position: list[float]
    joints: list[dict[str, Any]]  # The figures of _JOINT by name.
    # A text about the held object that counts as part of the tool while the gripper holds it; None if there is none.
    object: str | None


@dataclass(frozen=True, slots=True)
class KeptPair(PairDistance):
    """The distance of a monitored pair at home, and the least distance that it keeps [m]."""

    kept: float


@dataclass(frozen=True, slots=True)
class CellCheck:
    """The parts of a cell, as the controller uses them, and its faults. Distances are for arms at home [m].

    A cell without faults has an empty tuple ``faults``.
    """

    name: str
    arms: list[ArmCheck]
    obstacles: dict[str, ObstacleConfig]
    floor: float | None  # Height of the floor [m].
    monitored_pairs: int
    ignored_pairs: tuple[tuple[str, str], ...]  # Pairs that are not monitored because they overlap by construction.
    min_distance: float
    contacts: tuple[ContactPair, ...]  # Pairs that may touch in torque mode.
    nearest: list[KeptPair]  # Some pairs with the smallest distances at home, in the order of their distances.
    faults: tuple[str, ...]
    remedies: list[str]  # For pairs that are too close at home: lines to paste, and the file to paste them into.
    stop_torques: tuple[StopTorque, ...]  # The torques in a full stop, for each arm.
    driven: dict[str, str]  # The output to each arm's external controller; empty for the built-in controller.
    controls: dict[str, str]  # The action that each control of a hand causes.
    notes: list[str]  # Lines that a user should read, but that are not faults.
    verdict: str  # One line that says whether the cell can run.


def check_cell(config: Config) -> CellCheck:
    """Build the cell, and check it with its arms at home. Raises :class:`Q2R2Error` if it cannot be built."""
    (source, plant), lacking = _installed_classes(config)
    controls = getattr(source, "controls", None)
    if isinstance(controls, DeviceControls):  # The controls of other devices are known only when they are connected.
        config.teleop.bindings.check_device(controls)
    unknown_blocks = check_blocks(INPUTS, "input_settings", config.input_settings)
    unknown_blocks += check_blocks(PLANTS, "plant_settings", config.plant_settings)
    robot = Robot.from_config(config)
    # Here the settings still contain the pairs that may touch, so that their names and numbers are checked too. The
    # kept distances below are for position mode, in which these pairs must not touch.
    check_settings(robot, config.control)
    settings = config.control.without_contact()
    kept = kept_distances(robot, settings)
    pairs = zip(robot.distances(robot.home), kept.values.tolist(), strict=True)
    distances = sorted(pairs, key=lambda found: found[0].distance)
    arms = [_arm_check(config, robot, name) for name in robot.arms]
    stops = stop_torques(robot, robot.capped_acceleration(settings.acceleration_limit))
    notes = [
        *lacking,
        *unknown_blocks,
        *(f"{arm.name} arm: its tool includes {arm.object} that it holds" for arm in arms if arm.object),
    ]
    if config.external is not None and not config.external.filtered:
        notes.append(RAW_WARNING)
    notes += _notes_on_models(config, {robot.joint_names[index] for index in joints_in_degrees(robot)})
    notes += unchecked_notes(robot)
    if any(count > 1 for count in config.capsules.values()):
        notes.append(_capsules_note(config, robot))
    if config.note_on_grippers is not None:
        notes.append(config.note_on_grippers)
    for allowed in config.control.contact_allowed:
        inside = f"the reference gets inside by up to {1e3 * allowed.depth:g} mm at {1e3 * allowed.speed:g} mm/s"
        notes.append(f"{' and '.join(allowed.pair)} may touch in torque mode: {inside}")
    # No controller is built, because its kernels take minutes to compile. For arms at rest, its certificate would find
    # no other faults.
    faults = (*preflight_faults(robot, settings, None), *(() if plant is None else _plant_faults(config, robot)))
    return CellCheck(
        name=config.name,
        arms=arms,
        obstacles=dict(config.obstacles),
        floor=config.floor,
        monitored_pairs=len(distances),
        ignored_pairs=robot.ignored_pairs,
        min_distance=settings.min_distance,
        contacts=tuple(config.control.contact_allowed),
        nearest=[KeptPair(pair.name_a, pair.name_b, pair.distance, least) for pair, least in distances[:_NEAREST]],
        faults=faults,
        remedies=lines_to_paste(robot, config, near_at_home(robot, kept)),
        stop_torques=stops,
        driven={} if config.external is None else describe(config.external),
        controls=config.teleop.bindings.meanings(),
        notes=notes + [_stop_note(stop, shared=config.robot is not None) for stop in stops if stop.stop.ratio > 1.0],
        verdict=verdict_on(faults),
    )


def _installed_classes(config: Config) -> tuple[list[Any], list[str]]:
    """Return the classes of the cell's input and plant, and notes about missing packages.

    If a class needs a missing package, the class is None, and a note names the package. A missing package is not a
    fault of the cell, because another computer may have it.
    """
    classes: list[Any] = []
    notes: list[str] = []
    for group, name in ((INPUTS, config.input), (PLANTS, config.plant)):
        try:
            classes.append(load_class(group, name))
        except MissingPackageError as error:
            classes.append(None)
            notes.append(f"not checked: {error}")
    return classes, notes


def verdict_on(faults: Sequence[str]) -> str:
    """Return one line that says whether a cell with these ``faults`` can run."""
    return f"this cell cannot run: {counted(len(faults), 'fault')}" if faults else "this cell can run"


def _plant_faults(config: Config, robot: Robot) -> list[str]:
    """Return the reasons why the simulation cannot be built, for example an impossible inertia; empty if it can."""
    if config.plant != "mujoco":  # Other plants may open a device, which a check must not do.
        return []
    try:
        make_plant(config.plant, robot, config).close()
    except Q2R2Error as error:
        return [f"plant {config.plant}: {error}"]
    return []


def _notes_on_models(config: Config, in_degrees: Collection[str]) -> list[str]:
    """Return the notes that a user should read about the models.

    ``in_degrees`` are names of joints in the cell. A fault already says that their limits are in degrees. Therefore
    notes that ask for the unit of these joints are left out.
    """
    if config.robot is not None:
        models = [("robot", "", load_model(config.robot, config.packages, "robot"))]
    else:
        models = [
            (f"{side} arm", f"{side}_", load_model(arm, config.packages, f"arms.{side}"))
            for side, arm in config.arms.items()
        ]
    return [
        f"{part}: {note.text}"
        for part, prefix, model in models
        for note in model.notes
        if not (note.asks_for_units and prefix + note.joint in in_degrees)
    ]


def _capsules_note(config: Config, robot: Robot) -> str:
    """Return a note about links with several shapes.

    It has the number of shapes of each link, and the text of :func:`cost_of_shapes`.
    """
    names = [link_of(item.name) for item in robot.collision_model.geometryObjects]
    shapes = ", ".join(f"{link} {names.count(link)}" for link in config.capsules)
    # Without the additional shapes, some pairs of ``control.pairs`` would not exist. So ``control.pairs`` is left out.
    settings = config.control.model_copy(update={"pairs": ()})
    robots = (robot, Robot.from_config(config.model_copy(update={"capsules": {}, "control": settings})))
    steps = []
    for its in robots:
        with notice_of_compiling():
            controller = CartesianController(its, settings.without_contact())
        controller.reset(its.home)
        steps.append(partial(controller.step, {}, 1e-3))
    # Other programs only lengthen a tick, so the least times are compared. The two controllers take turns, so that
    # other programs disturb both of them alike.
    ticks = np.min([[timeit.timeit(step, number=1) for step in steps] for _ in range(_TICKS)], axis=0).tolist()
    cost = cost_of_shapes([len(its.collision_model.collisionPairs) for its in robots], ticks)
    return f"capsules: shapes of {shapes}; {cost}"


def cost_of_shapes(pairs: Sequence[int], ticks: Sequence[float]) -> str:
    """Return a text about the cost of the additional shapes in the cell's ``capsules``.

    The text names both numbers of monitored pairs. If a tick takes longer with the additional shapes, the text also
    names both times of a tick.

    Args:
        pairs: The number of monitored pairs with and without the additional shapes.
        ticks: The time of a tick with and without the additional shapes [s].
    """
    cost = f"{pairs[0]} pairs instead of {pairs[1]}"
    tick, before = (round(1e6 * time) for time in ticks)
    return f"{cost}, a tick at home {tick} instead of {before} us" if tick > before else cost


def _stop_note(stop: StopTorque, shared: bool) -> str:
    """Return a note on the joint of an arm that exceeds its torque limit most.

    It says how often a joint needs too much torque in random postures, and how to change that.

    ``shared`` is True if one model contains all arms. The names of joints then do not begin with the arm.
    """
    if stop.gravity.ratio > 1.0:
        worst, where = stop.gravity, "at rest, by gravity alone"
        helps = "the model's torque limits, masses and position limits"
    else:
        worst, where = stop.stop, "in a full stop from low speed, with the worst signs"
        prefix = "" if shared else f"{stop.arm}_"
        limits = {
            joint.joint.removeprefix(prefix): f"{math.floor(100 * stop.bearable * joint.acceleration) / 100:g}"
            for joint in stop.joints
        }
        each = ", ".join(f"{joint}: {limit}" for joint, limit in limits.items())
        helps = f"arms.{stop.arm}.acceleration_limit: {{{each}}}"
        if len(set(limits.values())) == 1:
            helps += f", or control.acceleration_limit: {next(iter(limits.values()))}"
    return (
        f"{stop.arm} arm: {where} {worst.joint} needs up to {worst.ratio:.2f} times its torque limit; some joint needs "
        f"too much in {100 * worst.share_over:.1f} % of {stop.postures} random postures. To change: {helps}"
    )


def _numbers(values: Iterable[float], form: str = "g") -> str:
    return " ".join(f"{value:{form}}" for value in values)


def _millimetres(*values: float) -> str:
    return _numbers(1e3 * value for value in values) + " mm"


def _object_of(config: HeldObjectConfig) -> str:
    sizes = f"a box of {_millimetres(*config.box)}" if config.box else f"a ball of radius {_millimetres(config.radius)}"
    return f"{sizes}, {config.mass:g} kg, at {_millimetres(*config.at)} in the tool frame"


def _arm_check(config: Config, robot: Robot, name: str) -> ArmCheck:
    arm, settings = robot.arms[name], next(arm for side, arm in config.arms.items() if side == name)
    flange, held = settings.flange, settings.gripper.object
    columns = (
        *(np.array(robot.joint_names), robot.position_lower, robot.home, robot.position_upper),
        *(robot.velocity_limit, robot.torque_limit),
    )
    rows = zip(*(column[list(arm.joints)].tolist() for column in columns), strict=True)
    sizes = flange.model
    if flange.thickness is not None and flange.radius is not None:
        sizes = f"{_millimetres(flange.thickness)} thick, radius {_millimetres(flange.radius)}"
    return ArmCheck(
        name=name,
        model=config.model_of(name),
        flange=sizes,
        tool_model=settings.tool.model,
        tool_frame=arm.tool_frame,
        tool_position=robot.tool_pose(robot.home, name).translation.tolist(),
        joints=[dict(zip(_JOINT, row, strict=True)) for row in rows],
        object=None if held is None else _object_of(held),
    )
