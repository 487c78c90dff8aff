"""The display of a run on a headset: states with their reasons, the robot, parts, targets, and the recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, cast

import numpy as np
import pinocchio as pin

from q2r2_control.device_words import DeviceWords
from q2r2_control.inputs.webxr.shown import Point, Seven, ShownArm, ShownPair, ShownScene, ShownState
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit, Array
from q2r2_control.viewer.arm_words import Told
from q2r2_control.viewer.shown_robot import ShownRobot
from q2r2_control.viewer.state_colours import state_colour
from q2r2_control.viewer.tightest_pair import TightestPair

_DIGITS = 4  # of metres and quaternions


class ShownTick(NamedTuple):
    """The shown part of a run. Words are made where this is sent."""

    tick: Tick
    binding: tuple[ActiveLimit, ...]  # limits that held a step back since the last one
    told: Mapping[str, Told]  # of each arm
    hands: Mapping[str, str]  # that drive each arm
    moved: Array | None  # MuJoCo's positions of all that moves
    recording: str


class RunDisplay:
    """Makes messages, in the process that sends them, where the robot is read from its URDF."""

    def __init__(self, run: ShownRobot, model: pin.Model, pairs: pin.GeometryModel, parts: Mapping[str, int]) -> None:
        """``pairs`` of bodies of the controller's ``model`` are monitored; ``parts`` are :func:`places_of_parts`."""
        self._run, self._model, self._pairs, self._parts = run, model, pairs, parts
        # The page knows what is in the operator's hands, and puts its words in.
        bound = {binding.control for binding in run.config.teleop.bindings.bound()}
        self._words = run.words(DeviceWords(nouns={control: f"{{{control}}}" for control in bound}))

    def scene(self) -> ShownScene:
        """Meshes, each in the frame of a joint, and the loose parts."""
        from q2r2_control.viewer.joint_tree import JointTree, colour_of  # for which trimesh is needed, an extra

        self._tree, self._tightest = JointTree(self._run), TightestPair(self._model, self._pairs)
        self._data = self._tree.model.createData()
        objects = self._run.config.mujoco.objects
        return {
            "name": self._run.config.name,
            "meshes": [
                {
                    "joint": joint,
                    "colour": colour,
                    "vertices": np.asarray(mesh.vertices).round(_DIGITS).ravel().tolist(),
                    "faces": np.asarray(mesh.faces).ravel().tolist(),
                }
                for joint, colour, mesh in self._tree.meshes()
            ],
            "hands": {arm: self._joints_of_tool(joints) for arm, joints in self._run.joints.items()},
            "parts": {
                name: {"size": cast(Point, tuple(objects[name].size)), "colour": colour_of(objects[name].colour)}
                for name in self._parts
            },
            "floor": self._run.config.floor or 0.0,
        }

    def _joints_of_tool(self, joints: Array) -> list[int]:
        """The last joint of an arm and all that it carries, as its fingers."""
        model = self._tree.model
        carried = [model.getJointId(self._run.joint_names[joints[-1]])]
        for joint in range(carried[0] + 1, model.njoints):
            if model.parents[joint] in carried:
                carried.append(joint)
        return carried

    def message(self, shown: ShownTick) -> ShownState:
        """A moment of the run."""
        tick, words = shown.tick, self._words
        words.told = shown.told
        pin.forwardKinematics(self._tree.model, self._data, self._tree.posture(tick.state.q, tick.grippers))
        arms: dict[str, ShownArm] = {
            arm: {
                "state": tick.states[arm],
                "why": words.why(tick, arm, shown.binding),
                "next": words.next_press(tick, arm),
                "colour": state_colour(tick.states[arm]),
                "hand": shown.hands[arm],
                "tool": _rounded(tool),
                "target": None if (target := tick.targets[arm].pose) is None else _rounded(target),
            }
            for arm, tool in tick.tools.items()
        }
        joints = [_rounded(placement) for placement in self._data.oMi]
        parts = {} if shown.moved is None else {name: _part(shown.moved, at) for name, at in self._parts.items()}
        return {"arms": arms, "joints": joints, "parts": parts, "pair": self._pair(tick), "recording": shown.recording}

    def _pair(self, tick: Tick) -> ShownPair | None:
        report = tick.reference.report
        self._tightest.place(tick.reference.q)
        ends = self._tightest.ends(report)
        if ends is None:
            return None
        first, second = ends.round(_DIGITS).tolist()
        return {"ends": (tuple(first), tuple(second)), "margin": round(report.margin, _DIGITS)}


def _rounded(pose: pin.SE3) -> Seven:
    return cast(Seven, tuple(round(number, _DIGITS) for number in pin.SE3ToXYZQUATtuple(pose)))


def _part(moved: Array, at: int) -> Seven:
    """The pose of a part, whose quaternion MuJoCo writes w x y z."""
    x, y, z, qw, qx, qy, qz = moved[at : at + 7].round(_DIGITS).tolist()
    return x, y, z, qx, qy, qz, qw
