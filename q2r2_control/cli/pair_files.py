"""SRDF files of pairs that can never meet, which sampling finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.config.cell import Config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.model_srdf import model_srdfs
from q2r2_control.robot.reachability import PairReach, Progress, nearest_approaches, srdf_of
from q2r2_control.robot.robot import Robot


@dataclass(frozen=True, slots=True)
class PairsWritten:
    """Sampled approaches of the monitored pairs of links; distances in metres."""

    file: str
    samples: int
    clearance: float
    never: tuple[PairReach, ...]  # farther apart than the clearance, farthest last
    watched: tuple[PairReach, ...]  # the others, nearest first


def write_pairs(
    config: Config, file: Path, samples: int, clearance: float, progress: Progress | None = None
) -> PairsWritten:
    """Sample which pairs of a cell can meet, and write those that cannot as an SRDF to a new ``file``.

    Raises :class:`ConfigError` for a clearance that is not above every distance in ``control``, and for a file that
    exists.
    """
    _check_clearance(config, clearance)
    if file.exists():
        raise ConfigError(f"{file}: exists; give the name of a new file")
    robot = Robot.from_config(config)
    found = nearest_approaches(robot, samples, 0, progress)
    _write({file: srdf_of(robot, found, clearance, samples)})
    never = tuple(pair for pair in found if pair.nearest > clearance)
    return PairsWritten(str(file), samples, clearance, never, tuple(pair for pair in found if pair not in never))


def write_model_pairs(
    config: Config, folder: Path, samples: int, clearance: float, progress: Progress | None = None
) -> dict[str, bool]:
    """Write the SRDF of each model of a cell to ``folder``; returns by path whether the file is new.

    Raises :class:`ConfigError` as :func:`write_pairs` does, and before anything is written for a file that exists and
    says something else.
    """
    _check_clearance(config, clearance)
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    files = {folder / name: text for name, text in model_srdfs(config, clearance, samples, 0, progress).items()}
    new = {file: text for file, text in files.items() if not file.exists()}
    for file, text in files.items():
        if file not in new and file.read_bytes() != text.encode():
            raise ConfigError(f"{file}: exists and says something else; remove it to have it written anew")
    _write(new)
    return {str(file): file in new for file in files}


def _check_clearance(config: Config, clearance: float) -> None:
    key, least = config.control.largest_distance
    if not least < clearance <= 1.0:
        raise ConfigError(f"clearance = {clearance:g} m: allowed: above control.{key}, {least:g}, up to 1")


def _write(files: Mapping[Path, str]) -> None:
    for file, text in files.items():
        try:
            file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{file}: cannot be written: {error}") from error
