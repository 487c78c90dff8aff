"""Facts that a recording states once: the cell, the robot, the program, the machine, and the settings of the run."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from q2r2_control.config.yaml_text import read_yaml, yaml_of
from q2r2_control.process.program import program
from q2r2_control.recording.messages import Topic, run_topics

if TYPE_CHECKING:  # These modules are not imported at run time, because the process of the writer does not need them.
    from q2r2_control.config.cell import Config
    from q2r2_control.pipeline.pipeline import Pipeline
    from q2r2_control.robot.robot import Robot

FORMAT = "4"  # The version of topics and fields. A recording of another version cannot be read.
LOOP, ROS = "loop", "ros"  # What a recording was made from: the ticks of one loop, or the messages of ROS nodes.
ABOUT, CONCLUSION = "q2r2_control", "q2r2_control_end"  # Names of the file's metadata records.
CELL, ROBOT, FIELDS = "cell.yaml", "robot.urdf", "fields.json"  # Names of the file's attachments.
# Notes that may contain the name of a person or of a computer. The note on the certificate is the path of a file.
_PERSONAL = ("operator", "host", "certificate")


@dataclass(frozen=True)
class About:
    """Facts that a run states at its beginning, stored as texts in a metadata record."""

    arms: tuple[str, ...]
    joints: tuple[str, ...]
    mode: str  # The command mode in which the pipeline drives the plant.
    plant_modes: tuple[str, ...]  # All command modes that the plant can follow.
    epoch: int  # The Unix time at which the run began [ns].
    realtime: bool
    cell: str  # The YAML of the cell, with all default values written out.
    robot: str  # The URDF of the robot.
    cameras: tuple[str, ...] = ()  # The cameras whose pictures are recorded.
    notes: dict[str, str] = field(default_factory=dict)  # Texts for people, such as program, machine and task.
    source: str = LOOP
    depth: tuple[str, ...] = ()  # The cameras whose depth is recorded too.

    @classmethod
    def of(cls, pipeline: Pipeline, realtime: bool, notes: Mapping[str, str], cameras: Sequence[str] = ()) -> About:
        """Describe a run that is about to begin.

        In real time the pipeline chooses its rate here, so that the recorded cell has the rate that a replay needs.

        Args:
            pipeline: The pipeline that is about to run.
            realtime: Whether the run is in real time.
            notes: Texts by name, such as ``task``, which are added to the notes on program and machine.
            cameras: The names of the cameras whose pictures are recorded.
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
            depth=tuple(name for name in cameras if pipeline.config.cameras[name].depth),
            notes={**program(), "plant": type(pipeline.plant).__name__, **notes},
        )

    def texts(self) -> dict[str, str]:
        left_out = ("cell", "robot", "notes") if self.depth else ("cell", "robot", "notes", "depth")
        run = {name: value for name, value in vars(self).items() if name not in left_out}
        return {"format": FORMAT, "run": json.dumps(run), **self.notes}

    @classmethod
    def from_texts(cls, texts: Mapping[str, str], cell: str, robot: str) -> About:
        """Read the result of :meth:`texts`.

        ``cell`` and ``robot`` are the texts of these fields, which the file stores separately. Raises
        :class:`KeyError`, :class:`ValueError` or :class:`TypeError` if ``texts`` are of another kind.
        """
        notes = dict(texts)
        if notes.pop("format") != FORMAT:
            raise ValueError(f"its format is {texts['format']}, this version reads {FORMAT}")
        run = json.loads(notes.pop("run"))
        for name in ("arms", "joints", "plant_modes", "cameras"):
            run[name] = tuple(run[name])
        run["depth"] = tuple(run.get("depth", ()))
        return cls(**run, cell=cell, robot=robot, notes=notes)

    def topics(self) -> dict[str, Topic]:
        return run_topics(self.arms, self.joints, self.cameras, self.depth)


@dataclass(frozen=True)
class Conclusion:
    """Facts that a run states at its end. If a run was killed, its recording has no conclusion."""

    success: bool | None = None  # The result of the task's own check; None if there was no check.
    ended_by: str | None = None  # The fault that ended the run; None if no fault did.

    def texts(self) -> dict[str, str]:
        success = {} if self.success is None else {"success": json.dumps(self.success)}
        return success if self.ended_by is None else {**success, "ended_by": self.ended_by}

    @classmethod
    def from_texts(cls, texts: Mapping[str, str]) -> Conclusion:
        """Read the result of :meth:`texts`. Raises :class:`ValueError` for other texts."""
        success = texts.get("success")
        return cls(None if success is None else bool(json.loads(success)), texts.get("ended_by"))


def as_yaml(config: Config) -> str:
    """Return the cell as YAML with all its defaults, so that new defaults of a later version do not change it."""
    return yaml_of(config.model_dump(mode="json"))


def anonymous(notes: Mapping[str, str]) -> dict[str, str]:
    """Return only the notes that name no person and no computer."""
    kept = {name: text for name, text in notes.items() if name not in _PERSONAL}
    if "machine" in kept:
        kept["machine"] = kept["machine"].partition(", ")[2]  # Only the operating system is kept.
    return kept


def changes(about: About, config: Config, robot: Robot) -> list[str]:
    """Return the changes of program, libraries, cell and robot since a run was recorded, as one line for each change.

    Args:
        about: The facts that the recorded run stated.
        config: The present cell.
        robot: The present robot.
    """
    now = program()
    found = [
        f"{name}: {about.notes[name]} when recorded, now {now.get(name, 'unknown')}"
        for name in ("version", "revision", "libraries")
        if name in about.notes and about.notes[name] != now.get(name)
    ]
    if about.cell != as_yaml(config):
        old, new = (dict(_flat(read_yaml(cell))) for cell in (about.cell, as_yaml(config)))
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
