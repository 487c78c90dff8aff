"""What a cell consists of, and what is wrong with it before anything moves."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from q2r2_control.config.arms import FlangeConfig, HeldObjectConfig
from q2r2_control.config.cell import Config, ObstacleConfig
from q2r2_control.config.control import ContactPair
from q2r2_control.config.external import describe
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.plugins import INPUTS, PLANTS, check_installed, load_class
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.model_srdf import model_srdfs
from q2r2_control.robot.reachability import PairReach, Progress, nearest_approaches, srdf_of
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import StopTorque, stop_torques
from q2r2_control.supervision.preflight import preflight_faults

_NEAREST = 8


@dataclass(frozen=True, slots=True)
class JointCheck:
    """One joint. Positions in rad (m for a sliding joint), velocity per second, torque in Nm (N)."""

    name: str
    lower: float
    home: float
    upper: float
    velocity: float
    torque: float


@dataclass(frozen=True, slots=True)
class ArmCheck:
    """One arm; ``tool_position`` [m] is in the world, at home."""

    name: str
    model: str
    flange: str | None  # model, or sizes
    tool_model: str | None
    tool_frame: str
    tool_position: tuple[float, ...]
    joints: tuple[JointCheck, ...]
    object: str | None = None  # what its gripper is to hold, which is part of the tool then


@dataclass(frozen=True, slots=True)
class KeptPair:
    """Distance of a monitored pair at home, and the one that it keeps [m]."""

    name_a: str
    name_b: str
    distance: float
    kept: float


@dataclass(frozen=True, slots=True)
class CellCheck:
    """A cell as the controller sees it. Distances in metres, at home; ``faults`` are empty for a good cell."""

    name: str
    arms: tuple[ArmCheck, ...]
    obstacles: dict[str, ObstacleConfig]
    floor: float | None  # height [m]
    monitored_pairs: int
    ignored_pairs: tuple[tuple[str, str], ...]  # overlap by construction
    min_distance: float
    contacts: tuple[ContactPair, ...]  # that may touch, in torque mode
    nearest: tuple[KeptPair, ...]  # nearest first
    faults: tuple[str, ...]
    stop_torques: tuple[StopTorque, ...]  # by arm
    driven: dict[str, str]  # by arm: what controllers of others are sent, empty for the built-in one
    controls: dict[str, str]  # what those of each hand do

    @property
    def notes(self) -> tuple[str, ...]:
        """One line for each thing that a user should know of and that is no fault."""
        held = (
            f"{arm.name} arm: while its gripper holds, its tool includes {arm.object}"
            for arm in self.arms
            if arm.object
        )
        touch = (
            f"{' and '.join(allowed.pair)} may touch in torque mode: the reference gets inside by up to "
            f"{1e3 * allowed.depth:g} mm, and closes in at {1e3 * allowed.speed:g} mm/s"
            for allowed in self.contacts
        )
        return (*held, *touch, *(_stop_note(stop) for stop in self.stop_torques if stop.stop.ratio > 1.0))

    def as_json(self) -> dict[str, Any]:
        """Plain data and dataclasses for the JSON writer."""
        data = {name: getattr(self, name) for name in self.__slots__}
        data["notes"] = self.notes
        data["obstacles"] = {name: obstacle.model_dump(mode="json") for name, obstacle in self.obstacles.items()}
        data["contacts"] = [allowed.model_dump(mode="json") for allowed in self.contacts]
        return data


def check_cell(config: Config, compiling: AbstractContextManager[None] | None = None) -> CellCheck:
    """Build the cell and look at it at home; ``compiling`` surrounds what may have to compile the controller first.

    Raises :class:`Q2R2Error` where the cell cannot be built.
    """
    config.teleop.bindings.check_device(load_class(INPUTS, config.input).controls)
    check_installed(PLANTS, config.plant)
    robot = Robot.from_config(config)
    with compiling or nullcontext():
        # With what may touch too, so that every name and number is checked; what is kept is that of position mode.
        CartesianController(robot, config.control)
        settings = config.control.without_contact()
        controller = CartesianController(robot, settings)
    kept = kept_distances(robot, settings).values.tolist()
    distances = sorted(zip(robot.distances(robot.home), kept, strict=True), key=lambda found: found[0].distance)
    return CellCheck(
        name=config.name,
        arms=tuple(_arm_check(config, robot, name) for name in robot.arms),
        obstacles=dict(config.obstacles),
        floor=config.floor,
        monitored_pairs=len(distances),
        ignored_pairs=robot.ignored_pairs,
        min_distance=settings.min_distance,
        contacts=tuple(config.control.contact_allowed),
        nearest=tuple(KeptPair(pair.name_a, pair.name_b, pair.distance, least) for pair, least in distances[:_NEAREST]),
        faults=preflight_faults(robot, settings, controller),
        stop_torques=stop_torques(robot, robot.capped_acceleration(settings.acceleration_limit)),
        driven={} if config.external is None else describe(config.external),
        controls=config.teleop.bindings.meanings(),
    )


@dataclass(frozen=True, slots=True)
class PairsWritten:
    """What sampling says of the monitored pairs of links; distances in metres."""

    file: str
    samples: int
    clearance: float
    never: tuple[PairReach, ...]  # farther apart than the clearance, farthest last
    watched: tuple[PairReach, ...]  # the others, nearest first


def write_pairs(
    config: Config, file: Path, samples: int, clearance: float, seed: int = 0, progress: Progress | None = None
) -> PairsWritten:
    """Sample which pairs of a cell can meet and write those that cannot as an SRDF to ``file``, which is not replaced.

    Raises :class:`ConfigError` for a clearance that is not above every distance in ``control``, and for a file that
    exists.
    """
    _check_clearance(config, clearance)
    if file.exists():
        raise ConfigError(f"{file}: exists; give the name of a new file")
    robot = Robot.from_config(config)
    approaches = nearest_approaches(robot, samples, seed, progress)
    _write(file, srdf_of(robot, approaches, clearance, samples))
    return PairsWritten(
        file=str(file),
        samples=samples,
        clearance=clearance,
        never=tuple(pair for pair in approaches if pair.nearest > clearance),
        watched=tuple(pair for pair in approaches if pair.nearest <= clearance),
    )


def write_model_pairs(
    config: Config, folder: Path, samples: int, clearance: float, seed: int = 0, progress: Progress | None = None
) -> dict[str, bool]:
    """Write the SRDF of each model of a cell to ``folder``; returns by path whether the file is new.

    Raises :class:`ConfigError` as :func:`write_pairs` does, and before anything is written for a file that exists and
    says something else.
    """
    _check_clearance(config, clearance)
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    files = {folder / name: text for name, text in model_srdfs(config, clearance, samples, seed, progress).items()}
    for file, text in files.items():
        if file.exists() and file.read_bytes() != text.encode():
            raise ConfigError(f"{file}: exists and says something else; remove it to have it written anew")
    new = {str(file): not file.exists() for file in files}
    for file, text in files.items():
        if new[str(file)]:
            _write(file, text)
    return new


def _check_clearance(config: Config, clearance: float) -> None:
    key, least = config.control.largest_distance
    if not least < clearance <= 1.0:
        raise ConfigError(f"clearance = {clearance:g} m: allowed: above control.{key}, {least:g}, up to 1")


def _write(file: Path, text: str) -> None:
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error}") from error


def _stop_note(stop: StopTorque) -> str:
    """What asks a joint of the arm for more torque than it has, where, how often, and what helps."""
    heavy = stop.gravity.ratio > 1.0
    worst = stop.gravity if heavy else stop.stop
    posture = " ".join(f"{position:.2f}" for position in worst.posture)
    most = f"{worst.joint} is asked for up to {worst.ratio:.2f} times its torque limit, at {posture} rad"
    often = (
        f"In {100 * worst.share_over:.1f} % of {stop.postures} random postures (seed {stop.seed}) a joint is asked for "
        "more than it has"
    )
    if heavy:
        return (
            f"{stop.arm} arm: by gravity alone, at rest, {most}. {often}, with a full stop in "
            f"{100 * stop.stop.share_over:.1f} %. No acceleration limit changes the former, only the model's torque "
            "limits, masses and ranges of positions"
        )
    return (
        f"{stop.arm} arm: where all joints stop at their acceleration limits from low speed, with the worst signs, "
        f"{most}. {often}; with {math.floor(100 * stop.bearable) / 100:.2f} times these limits, in none of them: "
        f"arms.{stop.arm}.acceleration_limit, control.acceleration_limit"
    )


def _flange_of(config: FlangeConfig) -> str | None:
    if config.thickness is None or config.radius is None:
        return config.model
    return f"{1e3 * config.thickness:g} mm thick, radius {1e3 * config.radius:g} mm"


def _object_of(config: HeldObjectConfig | None) -> str | None:
    if config is None:
        return None
    shape = f"a ball of radius {1e3 * config.radius:g} mm"
    if config.box is not None:
        shape = f"a box of {' x '.join(f'{1e3 * side:g}' for side in config.box)} mm"
    place = " ".join(f"{1e3 * value:g}" for value in config.at)
    return f"{shape}, {config.mass:g} kg, at {place} mm in the tool frame"


def _arm_check(config: Config, robot: Robot, name: str) -> ArmCheck:
    arm = robot.arms[name]
    settings = next(settings for side, settings in config.arms.items() if side == name)
    return ArmCheck(
        name=name,
        model=config.model_of(name),
        flange=_flange_of(settings.flange),
        tool_model=settings.tool.model,
        tool_frame=arm.tool_frame,
        tool_position=tuple(robot.tool_pose(robot.home, name).translation.tolist()),
        joints=tuple(
            JointCheck(
                name=robot.joint_names[index],
                lower=float(robot.position_lower[index]),
                home=float(robot.home[index]),
                upper=float(robot.position_upper[index]),
                velocity=float(robot.velocity_limit[index]),
                torque=float(robot.torque_limit[index]),
            )
            for index in arm.joints
        ),
        object=_object_of(settings.gripper.object),
    )
