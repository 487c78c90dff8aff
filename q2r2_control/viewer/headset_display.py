"""The display of a run on a headset: states with their reasons, the robot, targets, and the recording."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import pinocchio as pin

from q2r2_control.device_words import DeviceWords
from q2r2_control.events import ReasonKind
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.webxr.exchange import Display
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit
from q2r2_control.viewer.arm_words import Told, told_after
from q2r2_control.viewer.shown_robot import ShownRobot
from q2r2_control.viewer.state_colours import state_colour

_PERIOD = 1.0 / 30.0  # between messages [s]
_DIGITS = 4  # of metres and quaternions
_EPISODE_OVER = (
    ReasonKind.EPISODE_ENDS,
    ReasonKind.EPISODE_SUCCEEDED,
    ReasonKind.EPISODE_FAILED,
    ReasonKind.EPISODE_DISCARDED,
)


@runtime_checkable
class DisplayInput(Input, Protocol):
    """An input whose device shows the run, as a headset does."""

    def show_on(self, display: Display) -> None:
        """Show a run by ``display``; before ``start``."""

    def show(self, content: Any) -> bool:
        """Show the newest state; False where the last one still waits. Never waits."""

    def show_picture(self, jpeg: bytes) -> bool:
        """Show the newest picture of a camera, as :meth:`show`; from any thread."""


class ShownTick(NamedTuple):
    """The shown part of a run. Words are made where this is sent."""

    tick: Tick
    binding: tuple[ActiveLimit, ...]  # limits that held a step back since the last one
    told: Mapping[str, Told]  # of each arm
    recording: str


class RunDisplay:
    """Makes messages, in the process that sends them, where the robot is read from its URDF."""

    def __init__(self, run: ShownRobot) -> None:
        self._run = run
        # The page knows what is in the operator's hands, and puts its words in.
        bound = {binding.control for binding in run.config.teleop.bindings.bound()}
        self._words = run.words(DeviceWords(nouns={control: f"{{{control}}}" for control in bound}))

    def scene(self) -> Mapping[str, Any]:
        """Meshes, each in the frame of a joint."""
        from q2r2_control.viewer.joint_tree import JointTree  # for which trimesh is needed, an extra

        self._tree = JointTree(self._run)
        self._data = self._tree.model.createData()
        meshes = [
            {
                "joint": joint,
                "colour": colour,
                "vertices": np.asarray(mesh.vertices).round(_DIGITS).ravel().tolist(),
                "faces": np.asarray(mesh.faces).ravel().tolist(),
            }
            for joint, colour, mesh in self._tree.meshes()
        ]
        return {"meshes": meshes}

    def message(self, shown: ShownTick) -> Mapping[str, Any]:
        """Poses as x y z qx qy qz qw in the world, of joints by their index in the meshes."""
        tick, words = shown.tick, self._words
        words.told = shown.told
        pin.forwardKinematics(self._tree.model, self._data, self._tree.posture(tick.state.q, tick.grippers))
        arms = {
            arm: {
                "state": tick.states[arm],
                "why": words.why(tick, arm, shown.binding),
                "next": words.next_press(tick, arm),
                "colour": state_colour(tick.states[arm]),
                "target": None if (target := tick.targets[arm].pose) is None else _rounded(target),
            }
            for arm in tick.tools
        }
        joints = [_rounded(placement) for placement in self._data.oMi]
        return {"arms": arms, "joints": joints, "recording": shown.recording}


def _rounded(pose: pin.SE3) -> list[float]:
    return [round(number, _DIGITS) for number in pin.SE3ToXYZQUATtuple(pose)]


class HeadsetView:
    """A listener of one run. A tick stores references, 30 times a second the input's process gets them."""

    def __init__(self, source: DisplayInput, pipeline: Pipeline, recorded: bool) -> None:
        self._source, self._recorded = source, recorded
        self._due = 0.0  # of the next message, by the clock on the wall [s]
        self._binding: dict[ActiveLimit, None] = {}
        self._told: dict[str, Told] = {}
        self._episodes, self._open = 0, False
        source.show_on(RunDisplay(ShownRobot.of(pipeline.robot, pipeline.config)))
        pipeline.listeners.append(self)

    def __call__(self, tick: Tick) -> None:
        self._told = told_after(self._told, tick.events)
        for event in tick.events:
            if event.kind is ReasonKind.EPISODE_BEGINS:
                self._episodes, self._open = self._episodes + (not self._open), True
            elif event.kind in _EPISODE_OVER:
                self._open = False
        if tick.reference.report.binding:
            self._binding.update(dict.fromkeys(tick.reference.report.binding))
        now = time.monotonic()
        if now >= self._due and self._source.show(ShownTick(tick, tuple(self._binding), self._told, self._recording())):
            self._due = now + _PERIOD
            self._binding = {}

    def _recording(self) -> str:
        if not self._recorded:
            return ""
        return f"records episode {self._episodes}" if self._open else f"records; {self._episodes} episodes so far"
