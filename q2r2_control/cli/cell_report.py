"""What a cell consists of, and what is wrong with it before anything moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from q2r2_control.config.cell import Config, ObstacleConfig
from q2r2_control.config.external import describe
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.robot.reachability import PairReach, nearest_approaches, srdf_of
from q2r2_control.robot.robot import PairDistance, Robot
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
    tool_model: str | None
    tool_frame: str
    tool_position: tuple[float, ...]
    joints: tuple[JointCheck, ...]


@dataclass(frozen=True, slots=True)
class CellCheck:
    """A cell as the controller sees it. Distances in metres, at home; ``faults`` are empty for a good cell."""

    name: str
    arms: tuple[ArmCheck, ...]
    obstacles: dict[str, ObstacleConfig]
    monitored_pairs: int
    ignored_pairs: tuple[tuple[str, str], ...]  # overlap by construction
    min_distance: float
    nearest: tuple[PairDistance, ...]  # nearest first
    faults: tuple[str, ...]
    driven: dict[str, str]  # by arm: what controllers of others are sent, empty for the built-in one

    def as_json(self) -> dict[str, Any]:
        """Plain data and dataclasses for the JSON writer."""
        data = {name: getattr(self, name) for name in self.__slots__}
        data["obstacles"] = {name: obstacle.model_dump(mode="json") for name, obstacle in self.obstacles.items()}
        return data


def check_cell(config: Config) -> CellCheck:
    """Build the cell and look at it at home. Raises :class:`Q2R2Error` where it cannot be built."""
    robot = Robot.from_config(config)
    distances = sorted(robot.distances(robot.home), key=lambda pair: pair.distance)
    settings = config.control
    return CellCheck(
        name=config.name,
        arms=tuple(_arm_check(config, robot, name) for name in robot.arms),
        obstacles=dict(config.obstacles),
        monitored_pairs=len(distances),
        ignored_pairs=robot.ignored_pairs,
        min_distance=settings.min_distance,
        nearest=tuple(distances[:_NEAREST]),
        faults=preflight_faults(robot, settings, CartesianController(robot, settings)),
        driven={} if config.external is None else describe(config.external),
    )


@dataclass(frozen=True, slots=True)
class PairsWritten:
    """What sampling says of the monitored pairs of links; distances in metres."""

    file: str
    samples: int
    clearance: float
    never: tuple[PairReach, ...]  # farther apart than the clearance, farthest last
    watched: tuple[PairReach, ...]  # the others, nearest first


def write_pairs(config: Config, file: Path, samples: int, clearance: float, seed: int = 0) -> PairsWritten:
    """Sample which pairs of a cell can meet and write those that cannot as an SRDF to ``file``, which is not replaced.

    Raises :class:`ConfigError` for a clearance that is not above ``control.min_distance``, and for a file that exists.
    """
    least = config.control.min_distance
    if not least < clearance <= 1.0:
        raise ConfigError(f"clearance = {clearance:g} m: allowed: above control.min_distance, {least:g}, up to 1")
    if file.exists():
        raise ConfigError(f"{file}: exists; give the name of a new file")
    robot = Robot.from_config(config)
    approaches = nearest_approaches(robot, samples, seed)
    try:
        file.write_text(srdf_of(robot, approaches, clearance, samples), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error}") from error
    return PairsWritten(
        file=str(file),
        samples=samples,
        clearance=clearance,
        never=tuple(pair for pair in approaches if pair.nearest > clearance),
        watched=tuple(pair for pair in approaches if pair.nearest <= clearance),
    )


def _arm_check(config: Config, robot: Robot, name: str) -> ArmCheck:
    arm = robot.arms[name]
    settings = next(settings for side, settings in config.arms.items() if side == name)
    return ArmCheck(
        name=name,
        model=config.model_of(name),
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
    )
