"""What is said once in a recording: the cell, the robot, the program, the machine, and how the run was asked for."""

from __future__ import annotations

import json
import platform
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from q2r2_control.recording.topics import Topic, run_topics

if TYPE_CHECKING:  # the writer's process does without them
    from q2r2_control.config.cell import Config
    from q2r2_control.pipeline.pipeline import Pipeline

FORMAT = "3"  # of topics and fields; another one cannot be replayed
LOOP, ROS = "loop", "ros"  # sources: one loop's ticks, or what nodes published
ABOUT, CONCLUSION = "q2r2_control", "q2r2_control_end"  # metadata records
CELL, ROBOT, FIELDS = "cell.yaml", "robot.urdf", "fields.json"
_GIT_TIME = 2.0  # [s]


@dataclass(frozen=True)
class About:
    """Read from, and written to, a metadata record of texts."""

    arms: tuple[str, ...]
    joints: tuple[str, ...]
    mode: str  # of driving
    plant_modes: tuple[str, ...]  # that the plant follows
    epoch: int  # time of day at which the run began [ns]
    realtime: bool
    cell: str  # the YAML of the cell with all its defaults
    robot: str  # URDF
    cameras: tuple[str, ...] = ()  # of which there are pictures
    notes: dict[str, str] = field(default_factory=dict)  # program, machine, task and the like, for people
    source: str = LOOP

    @classmethod
    def of(cls, pipeline: Pipeline, realtime: bool, notes: Mapping[str, str], cameras: Sequence[str] = ()) -> About:
        """Of a run that is about to begin; ``notes`` are added to those on program and machine."""
        return cls(
            arms=tuple(pipeline.robot.arms),
            joints=tuple(pipeline.robot.joint_names),
            mode=str(pipeline.drive.mode),
            plant_modes=tuple(map(str, pipeline.plant.modes)),
            epoch=time.time_ns(),
            realtime=realtime,
            cell=as_yaml(pipeline.config),
            robot=pipeline.robot.urdf,
            cameras=tuple(cameras),
            notes={**program(), "plant": type(pipeline.plant).__name__, **notes},
        )

    def texts(self) -> dict[str, str]:
        """For the metadata record; cell and robot are attachments."""
        run = {name: value for name, value in vars(self).items() if name not in ("cell", "robot", "notes")}
        return {"format": FORMAT, "run": json.dumps(run), **self.notes}

    @classmethod
    def from_texts(cls, texts: Mapping[str, str], cell: str, robot: str) -> About:
        """Raises :class:`KeyError`, :class:`ValueError` and :class:`TypeError` for what is not one."""
        notes = dict(texts)
        if notes.pop("format") != FORMAT:
            raise ValueError(f"its format is {texts['format']}, this version reads {FORMAT}")
        run = json.loads(notes.pop("run"))
        for name in ("arms", "joints", "plant_modes", "cameras"):
            run[name] = tuple(run[name])
        return cls(**run, cell=cell, robot=robot, notes=notes)

    def topics(self) -> dict[str, Topic]:
        """All that is in the file of a loop's run, by name."""
        return run_topics(self.arms, self.joints, self.cameras)


@dataclass(frozen=True)
class Conclusion:
    """What is said of a run at its end; nothing of one that was killed."""

    success: bool | None = None  # by the task's own check; None: there was none
    ended_by: str | None = None  # the fault that ended it

    def texts(self) -> dict[str, str]:
        """For a metadata record."""
        success = {} if self.success is None else {"success": json.dumps(self.success)}
        return success if self.ended_by is None else {**success, "ended_by": self.ended_by}

    @classmethod
    def from_texts(cls, texts: Mapping[str, str]) -> Conclusion:
        """Raises :class:`ValueError` for what is not one."""
        success = texts.get("success")
        return cls(None if success is None else bool(json.loads(success)), texts.get("ended_by"))


def as_yaml(config: Config) -> str:
    """The cell with all its defaults, so that a later version's defaults change nothing."""
    return str(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))


def program() -> dict[str, str]:
    """Version, git revision where there is one, and machine."""
    notes = {"version": _version("q2r2_control"), "machine": f"{platform.node()}, {platform.platform()}"}
    notes["libraries"] = ", ".join(f"{name} {_version(name)}" for name in ("numpy", "pin", "numba", "daqp", "mujoco"))
    if revision := _revision():
        notes["revision"] = revision
    return notes


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _revision() -> str:
    """Of the checkout that this module is in, with a mark where it was changed; empty for an installed package."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / ".git").exists():
        return ""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=_GIT_TIME, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
