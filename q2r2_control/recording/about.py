"""Facts that a recording states once: cell, robot, program, machine, and how the run was asked for."""

from __future__ import annotations

import json
import platform
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from q2r2_control.recording.messages import Topic, run_topics

if TYPE_CHECKING:  # the writer's process does without them
    from q2r2_control.config.cell import Config
    from q2r2_control.pipeline.pipeline import Pipeline
    from q2r2_control.robot.robot import Robot

FORMAT = "4"  # of topics and fields; another one cannot be replayed
LOOP, ROS = "loop", "ros"  # sources: one loop's ticks, or what nodes published
ABOUT, CONCLUSION = "q2r2_control", "q2r2_control_end"  # metadata records
CELL, ROBOT, FIELDS = "cell.yaml", "robot.urdf", "fields.json"
_PERSONAL = ("operator", "host", "certificate")  # notes; of the last one, the path
_GIT_TIME = 2.0  # [s]


@dataclass(frozen=True)
class About:
    """Facts that a run states at its beginning, in a metadata record of texts."""

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
        """Describe a run that is about to begin; ``notes`` are added to those on program and machine.

        In real time the pipeline chooses its rate now, since the recorded cell has to name it for a replay.
        """
        if realtime:
            pipeline.fit_rate()
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
        return run_topics(self.arms, self.joints, self.cameras)


@dataclass(frozen=True)
class Conclusion:
    """Facts that a run states at its end; none of one that was killed."""

    success: bool | None = None  # by the task's own check; None: there was none
    ended_by: str | None = None  # the fault that ended it

    def texts(self) -> dict[str, str]:
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
    """Version, machine, and of a checkout the git revision, with a mark where it was changed."""
    notes = {"version": _version("q2r2_control"), "machine": f"{platform.node()}, {platform.platform()}"}
    notes["libraries"] = ", ".join(f"{name} {_version(name)}" for name in ("numpy", "pin", "numba", "daqp", "mujoco"))
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / ".git").exists():
        command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40"]
        with suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_TIME, check=True)
            notes["revision"] = done.stdout.strip()
    return notes


def anonymous(notes: Mapping[str, str]) -> dict[str, str]:
    """The notes without those that tell of a person or of a computer's name and address."""
    kept = {name: text for name, text in notes.items() if name not in _PERSONAL}
    if "machine" in kept:
        kept["machine"] = kept["machine"].partition(", ")[2]  # only the operating system
    return kept


def changes(about: About, config: Config, robot: Robot) -> list[str]:
    """The changes since a run was recorded: program, libraries, cell, robot; a line each."""
    now = program()
    found = [
        f"{name}: {about.notes[name]} when recorded, now {now.get(name, 'unknown')}"
        for name in ("version", "revision", "libraries")
        if name in about.notes and about.notes[name] != now.get(name)
    ]
    if about.cell != as_yaml(config):
        old, new = dict(_flat(yaml.safe_load(about.cell))), dict(_flat(yaml.safe_load(as_yaml(config))))
        for key in dict.fromkeys((*old, *new)):
            if old.get(key) != new.get(key):
                found.append(f"cell: {key}: {old.get(key, 'nothing')} when recorded, now {new.get(key, 'nothing')}")
    if about.robot != robot.urdf:
        found.append("the robot's description is not the recorded one")
    return found


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, Mapping) and data:
        for name, value in data.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, data


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
